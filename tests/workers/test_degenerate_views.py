"""Views from which nothing can be made, through the whole system and into the backend alone."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from prism_edge.backend.mapper import Mapper
from prism_edge.bus import codec
from prism_edge.config import BackendConfig
from prism_edge.messages import Frame, Keyframe, MapUpdate
from prism_edge.tracking.map_correction import flaw
from tests.backend.world import Teller, poses_of, quiet, told_depth
from tests.tracking.cloud import pose_at
from tests.workers.whole_system import WholeSystem, finite, numbers_of


def test_images_without_corners_end_in_lost_and_nothing_else() -> None:
    blank = range(60, 76)

    def blanked(made: Frame) -> Frame:
        return replace(made, image=np.full_like(made.image, 90)) if made.index in blank else made

    system = WholeSystem()
    bus = system.play(110, blanked)
    errors, words = system.errors(), system.words()
    assert finite(bus)
    assert not set(errors) & set(blank)
    assert words[blank[0]] == "degraded"
    assert words[blank[-1]] == "lost"
    assert set(range(80, 110)) <= set(errors), "found again"
    assert max(errors.values()) < 0.06
    assert words[105] == "ok"


def test_a_camera_that_stands_still_makes_no_trouble() -> None:
    """From the first image on, with noise of its own in each: no parallax at all; then it moves."""
    rng = np.random.default_rng(0)
    still = 60

    def held(made: Frame) -> Frame:
        image = made.image + rng.normal(0.0, 1.0, made.image.shape)
        return replace(made, image=np.clip(np.rint(image), 0, 255).astype(np.uint8))

    system = WholeSystem(delay=still)
    bus = system.play(140, held)
    errors = system.errors()
    assert finite(bus)
    assert len(errors) == 139
    assert max(v for i, v in errors.items() if i < still) < 0.02
    assert max(errors.values()) < 0.06
    assert system.words()[135] == "ok"


def told(name: str) -> tuple[Teller, list[np.ndarray]]:
    """A scene and where it is seen from: each of them leaves something undetermined."""
    teller = Teller(noise_px=0.5)
    steps = range(7)
    if name == "two keyframes at one pose":
        return teller, [pose_at(0.15 * (i if i < 4 else i - 1)) for i in steps]
    if name == "all keyframes at one pose":
        return teller, [np.eye(4) for _ in steps]
    if name == "a turn alone":
        return teller, [pose_at(0.0, 0.0, 0.0, 0.0, -0.03 * i) for i in steps]
    if name == "a planar scene":
        teller.cloud.positions *= 3.0 / teller.cloud.positions[:, 2:]
    if name == "a plane without parallax":
        teller.cloud.positions *= 50.0 / teller.cloud.positions[:, 2:]
        return teller, [pose_at(0.001 * i) for i in steps]
    if name == "all points on one line":
        teller.cloud.positions = np.linspace((-1.0, 0.0, 3.0), (1.0, 0.2, 5.0), 300)
    if name == "all points in one spot":
        teller.cloud.positions = np.array([0.0, 0.0, 4.0]) + 1e-6 * teller.cloud.positions
    return teller, [pose_at(0.15 * i, 0.02 * i) for i in steps]


SCENES = (
    "two keyframes at one pose",
    "all keyframes at one pose",
    "a turn alone",
    "a planar scene",
    "a plane without parallax",
    "all points on one line",
    "all points in one spot",
)
WELL_POSED = ("two keyframes at one pose", "a planar scene")


def sound(update: MapUpdate | None) -> bool:
    """Whether the tracker could take an update: none at all, or finite and in its rules."""
    if update is None:
        return True
    arrived = codec.unpack(codec.pack(update), MapUpdate)
    return not flaw(arrived) and all(np.isfinite(n).all() for n in numbers_of(arrived))


@pytest.mark.parametrize("use_depth", [True, False], ids=["depth", "no depth"])
@pytest.mark.parametrize("scene", SCENES)
def test_a_degenerate_window_gives_finite_numbers_and_the_next_one_works(scene: str, use_depth: bool) -> None:
    mapper, (teller, poses) = Mapper(BackendConfig(), use_depth), told(scene)
    one_for_all = np.ones(16, np.float32)
    depth = np.full((48, 64), float(teller.cloud.positions[:, 2].mean()), np.float32)
    for pose in poses:
        keyframe = teller.keyframe(pose)
        mapper.absorb(keyframe)
        mapper.add_depth(keyframe, told_depth(depth, np.array([0.1, 0.0, 0.1, 0.0]), math.nan, ""), 0.0)
        mapper.loops.add_place(keyframe.id, one_for_all)
        assert sound(mapper.optimise(keyframe.id, 0.0))
        assert mapper.loops.look(keyframe.id) is None
    if scene in WELL_POSED:
        for k, pose in poses_of(mapper.world).items():
            assert np.linalg.norm(pose[:3, 3] - poses[k][:3, 3]) < 0.05
    # A well-posed epoch after it is solved as if nothing had been.
    after = Teller(epoch=1, noise_px=0.3, first=100)
    for i in range(4):
        mapper.absorb(after.keyframe(pose_at(0.2 * i, 0.0, 0.0, 0.0, -0.03 * i)))
    update = mapper.optimise(103, 0.0)
    assert update is not None
    assert sound(update)
    assert np.linalg.norm(poses_of(mapper.world)[103][:3, 3] - after.poses[3][:3, 3]) < 0.03


def test_a_keyframe_without_features_is_taken_in_and_passed_over() -> None:
    mapper, teller = Mapper(BackendConfig()), Teller(noise_px=0.3)
    told: list[Keyframe] = []
    for i in range(3):
        told.append(teller.keyframe(pose_at(0.2 * i)))
        mapper.absorb(told[-1])
    assert mapper.optimise(2, 0.0) is not None
    empty = quiet(told[-1])
    mapper.absorb(empty)
    depth = np.full((48, 64), 3.0, np.float32)
    mapper.add_depth(empty, told_depth(depth, np.array([0.1, 0.0, 0.1, 0.0]), math.nan, ""), 0.0)
    mapper.loops.add_place(empty.id, np.ones(16, np.float32))
    assert sound(mapper.optimise(empty.id, 0.0))
    assert mapper.loops.look(empty.id) is None
    teller.poses.append(teller.poses[-1])  # its number is taken
    mapper.absorb(teller.keyframe(pose_at(0.6)))
    update = mapper.optimise(4, 0.0)
    assert update is not None
    assert sound(update)
    assert np.linalg.norm(poses_of(mapper.world)[4][:3, 3] - (0.6, 0.0, 0.0)) < 0.03
