"""A rolling shutter's readout against cameras that see each row at its own time."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from prism_edge.backend import readout
from prism_edge.backend.global_map import GlobalKeyframe, GlobalMap, GlobalPoint
from prism_edge.backend.readout import FEWEST, LEAST_MS, Readout, readout_of, take_out
from prism_edge.geometry.cameras import Camera
from prism_edge.geometry.poses import inverse, se3_exp, se3_log, transform
from prism_edge.tracking.features import Features
from tests.tracking.cloud import CAMERA, Cloud

BENT = replace(CAMERA, distortion=(-0.2, 0.05, 0.0, 0.0))
FISHEYE = Camera(640, 480, 300.0, 300.0, 320.0, 240.0, "fisheye", (0.02, 0.01, 0.0, 0.0))
POINTS = 150
NOISE_PX = 1.0  # what a keypoint of the finest level is given


def pose_at_time(t: float) -> np.ndarray:
    """Of a hand that looks about: world_from_camera at ``t`` seconds."""
    swing = np.array([0.5 * np.sin(0.9 * t), 0.2 * np.sin(1.7 * t), 0.3 * np.sin(0.5 * t)])
    turn = np.array([0.1 * np.sin(1.3 * t), 0.25 * np.sin(1.1 * t + 1.0), 0.2 * np.sin(0.8 * t)])
    return se3_exp(np.concatenate([swing, turn]))


def twist_at_time(t: float) -> np.ndarray:
    """By differences, a second, in the camera's frame."""
    return se3_log(inverse(pose_at_time(t - 1e-4)) @ pose_at_time(t + 1e-4)) / 2e-4


@cache  # most maps here differ by their noise alone
def seen(camera: Camera, seed: int, t: float, readout_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Raw pixels of a cloud in the image, each by the camera of its own row's time, and which points."""
    points = Cloud(POINTS, seed).positions
    rows = np.full(len(points), camera.height / 2.0)
    for _ in range(8):
        times, before = t + ((rows + 0.5) / camera.height - 0.5) * readout_s, rows
        cameras = [inverse(pose_at_time(time)) for time in times]
        local = np.array([transform(c, p[None])[0] for c, p in zip(cameras, points, strict=True)])
        pixels = camera.project(local)
        rows = np.clip(pixels[:, 1], 0.0, camera.height)
        if np.abs(rows - before).max() < 1e-9:
            break
    inside = np.all((pixels > 0) & (pixels < (camera.width, camera.height)), axis=1) & (local[:, 2] > 0.2)
    return pixels[inside], np.flatnonzero(inside)


def world_of(
    readout_ms: float, camera: Camera = CAMERA, keyframes: int = 20, seed: int = 0, noise_px: float = NOISE_PX
) -> GlobalMap:
    """A map of keyframes 0.4 s apart, poses and points a little aside."""
    world, rng, points = GlobalMap(), np.random.default_rng(seed), Cloud(POINTS, seed).positions
    for p, place in enumerate(points):
        world.points[p] = GlobalPoint(place + rng.normal(0.0, 0.01, 3), parallax_deg=5.0)
    for k in range(keyframes):
        t = 0.4 * k
        raw, which = seen(camera, seed, t, 1e-3 * readout_ms)
        pixels = camera.undistort_pixels(raw + rng.normal(0.0, noise_px, raw.shape))
        aside = np.zeros(6) if k == 0 else rng.normal(0.0, 0.003, 6)
        observed = {int(p): i for i, p in enumerate(which)}
        pose = pose_at_time(t) @ se3_exp(aside)
        world.keyframes[k] = GlobalKeyframe(
            k, k, camera, pose, pixels, np.ones(len(pixels)), observed, twist=twist_at_time(t)
        )
        for p in observed:
            world.points[p].keyframes.add(k)
    return world


@pytest.mark.parametrize(
    ("readout_ms", "camera"), [(0.0, CAMERA), (26.0, CAMERA), (-20.0, CAMERA), (26.0, BENT), (30.0, FISHEYE)]
)
def test_it_is_found_beside_poses_and_points(readout_ms, camera):
    found = readout_of(world_of(readout_ms, camera))
    assert found.keyframes == 20
    assert abs(found.ms - readout_ms) < 3.5 * found.sigma_ms
    assert 0.2 < found.sigma_ms < 2.0
    assert found.is_clear == (readout_ms != 0.0)


def test_its_sigma_is_that_of_its_errors():
    found = [readout_of(world_of(15.0, seed=seed)) for seed in range(6)]
    errors = np.array([(f.ms - 15.0) / f.sigma_ms for f in found])
    assert 0.4 < np.sqrt((errors**2).mean()) < 1.7


def test_without_noise_it_is_exact():
    """But for what a motion is not a steady one within an image."""
    assert readout_of(world_of(26.0, noise_px=0.0)).ms == pytest.approx(26.0, abs=0.1)


def test_from_a_map_that_is_ten_centimetres_off_it_comes_to_the_same():
    """A step that is no more than a twentieth of a sigma is the last, no sooner."""
    near, far, rng = world_of(20.0, keyframes=14), world_of(20.0, keyframes=14), np.random.default_rng(1)
    for keyframe in far.keyframes.values():
        aside = rng.normal(0.0, (0.1, 0.1, 0.1, 0.03, 0.03, 0.03))
        keyframe.world_from_camera = keyframe.world_from_camera @ se3_exp(aside)
    for point in far.points.values():
        point.position = point.position + rng.normal(0.0, 0.2, 3)
    found = readout_of(near)
    assert readout_of(far).ms == pytest.approx(found.ms, abs=0.05 * found.sigma_ms)


def test_mismatches_do_not_move_it():
    world, rng = world_of(20.0), np.random.default_rng(3)
    for keyframe in world.keyframes.values():
        wrong = rng.choice(len(keyframe.pixels), len(keyframe.pixels) // 20, replace=False)
        keyframe.pixels[wrong] += rng.uniform(20.0, 60.0, (len(wrong), 2))
    found = readout_of(world)
    assert abs(found.ms - 20.0) < 5.0 * found.sigma_ms


def test_a_keypoint_counts_by_its_sigma():
    world, coarse = world_of(20.0, keyframes=14), world_of(20.0, keyframes=14)
    for keyframe in coarse.keyframes.values():
        keyframe.sigmas = 2.0 * keyframe.sigmas
    assert readout_of(coarse).sigma_ms == pytest.approx(2.0 * readout_of(world).sigma_ms, rel=0.1)


def test_of_a_large_map_the_newest_keyframes_are_asked(monkeypatch):
    monkeypatch.setattr(readout, "MOST", 15)
    world = world_of(20.0)
    for k in range(5):
        world.keyframes[k].twist = -world.keyframes[k].twist
    found = readout_of(world)
    assert found.keyframes == 15
    assert abs(found.ms - 20.0) < 3.5 * found.sigma_ms


def test_of_crowded_keyframes_some_points_are_enough(monkeypatch):
    monkeypatch.setattr(readout, "OBSERVATIONS", 30)
    few = readout_of(world_of(20.0))
    monkeypatch.undo()
    all_of_them = readout_of(world_of(20.0))
    assert few.sigma_ms > 1.05 * all_of_them.sigma_ms
    assert abs(few.ms - 20.0) < 3.5 * few.sigma_ms


def threefold(world: GlobalMap) -> GlobalMap:
    """The same, after a loop has said how large it is."""
    for keyframe in world.keyframes.values():
        keyframe.world_from_camera = keyframe.world_from_camera.copy()
        keyframe.world_from_camera[:3, 3] *= 3.0
        keyframe.grown = 3.0
    for point in world.points.values():
        point.position = 3.0 * point.position
    return world


def test_a_part_that_grew_moved_as_much_faster():
    assert readout_of(threefold(world_of(20.0))).ms == pytest.approx(readout_of(world_of(20.0)).ms, abs=0.1)


def test_keyframes_whose_motion_nobody_knows_have_no_say():
    world = world_of(20.0, keyframes=FEWEST + 1)
    world.keyframes[0].twist = np.zeros(6)
    world.keyframes[FEWEST].twist = np.full(6, np.nan)
    assert readout_of(world) is None, "one too few"
    world.keyframes[0].twist = twist_at_time(0.0)
    assert readout_of(world).keyframes == FEWEST


def test_a_map_that_says_nothing_is_not_made_to():
    assert readout_of(GlobalMap()) is None
    alone = world_of(20.0)
    for point in alone.points.values():
        point.parallax_deg = 0.1  # placed by depth
    assert readout_of(alone) is None


def test_it_is_clear_by_its_sigmas_and_in_itself():
    assert not Readout(LEAST_MS - 0.1, 0.01, 60).is_clear
    assert not Readout(-14.9, 3.0, 60).is_clear
    assert Readout(15.1, 3.0, 60).is_clear
    assert Readout(25.0, 2.0, 20).is_clear
    assert Readout(-25.0, 2.0, 20).is_clear


def test_one_that_was_found_before_is_followed_sooner():
    assert Readout(4.0, 1.0, 20).is_news
    assert Readout(-4.0, 1.3, 20).is_news
    assert not Readout(4.0, 1.4, 20).is_news
    assert not Readout(0.9, 0.1, 60).is_news
    assert Readout(0.0, 0.9, 60).is_well_known
    assert not Readout(0.0, 1.1, 60).is_well_known


@pytest.mark.parametrize("camera", [CAMERA, BENT])
def test_what_is_taken_out_is_not_found_again(camera):
    world = world_of(26.0, camera)
    for keyframe in world.keyframes.values():
        pixels = keyframe.pixels
        octaves, descriptors = np.zeros(len(pixels), np.intp), np.zeros((len(pixels), 4), np.uint64)
        keyframe.features = Features.build(pixels, octaves, descriptors, camera.width, camera.height)
    take_out(world, 20.0)
    take_out(world, 6.0)
    assert world.readout_ms == 26.0
    left = readout_of(world)
    # Each keypoint is moved as if it were as far away as most.
    assert abs(left.ms) < max(3.5 * left.sigma_ms, 2.0)
    for keyframe in world.keyframes.values():
        assert np.array_equal(keyframe.pixels, keyframe.features.pixels)


def test_keyframes_of_which_nobody_knows_how_they_moved_stay_as_they_are():
    world = world_of(26.0, keyframes=4)
    world.keyframes[1].twist = np.zeros(6)
    world.keyframes[2].twist = np.full(6, np.nan)
    world.keyframes[3].observed.clear()
    before = [world.keyframes[k].pixels.copy() for k in range(4)]
    take_out(world, 26.0)
    stayed = [np.array_equal(before[k], world.keyframes[k].pixels) for k in range(4)]
    assert stayed == [False, True, True, True]


def test_no_more_is_taken_out_than_a_camera_can_have():
    world = world_of(26.0, keyframes=2)
    take_out(world, 70.0)
    take_out(world, 70.0)
    assert world.readout_ms == 100.0
    take_out(world, -900.0)
    assert world.readout_ms == -100.0


def test_keypoints_are_moved_by_what_the_map_then_says_was_taken_out_and_no_more():
    """The tracker moves its own by that: both would see two worlds."""
    at_most, beyond = (world_of(0.0, keyframes=2) for _ in range(2))
    take_out(at_most, readout.LONGEST_READOUT_MS)
    take_out(beyond, 3.0 * readout.LONGEST_READOUT_MS)
    take_out(beyond, 5.0)  # nothing is left of what a camera can have
    assert beyond.readout_ms == at_most.readout_ms
    for k, keyframe in at_most.keyframes.items():
        assert np.array_equal(beyond.keyframes[k].pixels, keyframe.pixels)


def test_a_keyframe_of_a_part_that_grew_is_moved_as_much():
    world, grown = world_of(26.0, keyframes=2), threefold(world_of(26.0, keyframes=2))
    take_out(world, 26.0)
    take_out(grown, 26.0)
    np.testing.assert_allclose(grown.keyframes[1].pixels, world.keyframes[1].pixels, atol=1e-9)
