"""Keyframes that no correction knew are put right by the tracker; the rest of the map holds them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from prism_edge.backend.local_copy import local_copy
from prism_edge.backend.mapper import Mapper
from prism_edge.config import BackendConfig, Config, TrackingConfig
from prism_edge.geometry.poses import inverse, rotation_angle, se3_exp, transform
from prism_edge.tracking import mapping, unheard
from prism_edge.tracking.frame_tracking import TrackedFrame
from prism_edge.tracking.local_map import LocalMap
from prism_edge.tracking.map_correction import apply_correction
from prism_edge.tracking.submaps import Parts
from prism_edge.tracking.tracker import Tracker
from prism_edge.tracking.unheard import adjust_unheard
from prism_edge.workers.ablated import tracking_of
from tests.backend.ring import Ring
from tests.synthetic.messages import map_update
from tests.tracking.cloud import BY_POINTS, Cloud, check, pose_at
from tests.tracking.film_run import CONFIG, Run

HEARD, UNHEARD = 12, 5  # keyframes
WAYS = np.cumsum([0.0, *[0.03] * (HEARD - 4), *[0.15] * (UNHEARD + 3)])
POSES = [pose_at(way, way / 15.0, 0.0, 0.0, way / 1.5, 0.0) for way in WAYS]


def bent(drift: float = 1.0, seed: int = 0) -> tuple[LocalMap, dict[int, np.ndarray]]:
    """A map whose newest keyframes drifted off with the points they made, and where all points truly are."""
    cloud = Cloud(2000, seed)
    cloud.positions[:, 0] = cloud.rng.uniform(-0.75, 2.2, 2000) * cloud.positions[:, 2]
    world, shown = cloud.mapped(POSES, noise_px=0.3)
    true = {
        int(point): cloud.positions[at]
        for keyframe, seen in zip(world.keyframes.values(), shown, strict=True)
        for point, at in zip(keyframe.points.tolist(), seen.tolist(), strict=True)
    }
    world.heard = HEARD - 1
    rng, walked = np.random.default_rng(seed), np.eye(4)
    for number in range(HEARD, HEARD + UNHEARD):
        keyframe = world.keyframes[number]
        walked = walked @ se3_exp(drift * rng.normal(0.0, (0.02, 0.02, 0.02, 0.01, 0.01, 0.01)))
        keyframe.world_from_camera = walked @ keyframe.world_from_camera
        made = world.points.reference == number
        world.points.position[made] = transform(walked, world.points.position[made])
    for keyframe in world.keyframes.values():
        mapping.introduce(world, keyframe)
    return world, true


def errors(world: LocalMap) -> tuple[float, float]:
    """The largest of the newest keyframes' errors, m and rad."""
    off = [inverse(POSES[k]) @ world.keyframes[k].world_from_camera for k in range(HEARD, HEARD + UNHEARD)]
    return (
        max(float(np.linalg.norm(m[:3, 3])) for m in off),
        max(rotation_angle(m[:3, :3]) for m in off),
    )


@pytest.mark.parametrize("seed", range(4))
def test_what_bent_is_straight_again(seed: int) -> None:
    world, true = bent(seed=seed)
    table = world.points
    new = np.flatnonzero((table.reference >= HEARD) & (table.observations >= 2))
    assert len(new) > 100
    places = np.array([true[p] for p in table.ids[new].tolist()])
    assert errors(world)[0] > 0.03
    rays = places - POSES[-1][:3, 3]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    before = np.median(np.linalg.norm(np.cross(table.position[new] - places, rays), axis=1))
    assert adjust_unheard(world, 3, 1.0, BY_POINTS)
    shift, turn = errors(world)
    assert shift < 0.004
    assert turn < 0.001
    aside = np.median(np.linalg.norm(np.cross(table.position[new] - places, rays), axis=1))
    assert aside < 0.3 * before, "how far they are is the keypoints' noise, most of all"
    check(world)


def test_the_rest_of_the_map_is_held() -> None:
    world, _ = bent()
    before = {k: world.keyframes[k].world_from_camera.copy() for k in range(HEARD)}
    old = np.flatnonzero(world.points.reference < HEARD)
    places = world.points.position[old].copy()
    assert adjust_unheard(world, 3, 1.0, BY_POINTS)
    assert all(np.array_equal(world.keyframes[k].world_from_camera, pose) for k, pose in before.items())
    assert np.array_equal(world.points.position[old], places)


def test_what_its_maker_alone_sees_holds_nothing_and_goes_along() -> None:
    """Seeds of a keyframe fit it wherever it is: held, they would hold it there."""
    world, _ = bent()
    newest = world.newest()
    extra, _ = Cloud(300, seed=9).keyframe(newest.id, newest.world_from_camera)
    features = replace(
        newest.features,
        pixels=np.concatenate([newest.features.pixels, extra.features.pixels]),
        octaves=np.concatenate([newest.features.octaves, extra.features.octaves]),
        descriptors=np.concatenate([newest.features.descriptors, extra.features.descriptors]),
    )
    newest.features, many = features, len(extra.points)
    newest.points = np.concatenate([newest.points, extra.points])
    keypoints = np.arange(len(newest.points) - many, len(newest.points))
    rays = newest.camera.ideal().normalise(features.pixels[keypoints])
    local = 3.0 * np.column_stack([rays, np.ones(many)])
    places = transform(newest.world_from_camera, local)
    ids = world.add_points(newest, keypoints, places, np.full(many, 0.2), 0.0)
    assert adjust_unheard(world, 3, 1.0, BY_POINTS)
    assert errors(world)[0] < 0.004
    there = transform(inverse(newest.world_from_camera), world.points.position[world.points.rows(ids)])
    assert np.allclose(there, local)


@pytest.mark.parametrize(
    ("least", "heard", "why"),
    [
        (UNHEARD + 1, HEARD - 1, "too few"),
        (0, HEARD - 1, "switched off"),
        (3, -1, "nothing has been corrected yet"),
        (3, HEARD - 2, "the map is young: the backend's windows are all of it"),
        (1, HEARD + UNHEARD, "none unheard"),
    ],
)
def test_nothing_is_done(least: int, heard: int, why: str) -> None:
    world, _ = bent()
    world.heard = heard
    poses = {k: keyframe.world_from_camera.copy() for k, keyframe in world.keyframes.items()}
    places = world.points.position.copy()
    assert not adjust_unheard(world, least, 1.0, BY_POINTS), why
    assert all(np.array_equal(world.keyframes[k].world_from_camera, pose) for k, pose in poses.items())
    assert np.array_equal(world.points.position, places)


def test_a_part_that_nothing_joins_is_left_to_the_backend() -> None:
    world, _ = bent()
    cloud = Cloud(400, seed=8)
    ids = np.full(len(cloud.positions), -1, np.int64)
    for number in range(30, 34):
        keyframe, seen = cloud.keyframe(number, pose_at(0.1 * (number - 30)))
        keyframe.points = ids[seen]
        world.add_keyframe(keyframe)
        free = keyframe.free()
        places = cloud.positions[seen[free]]
        places += cloud.rng.normal(0.0, 0.05, places.shape)  # so that there would be much to adjust
        ids[seen[free]] = world.add_points(keyframe, free, places, np.full(len(free), 0.1), 2.0)
        mapping.introduce(world, keyframe)
    world.heard = HEARD + UNHEARD - 1
    before = world.points.position.copy()
    assert not adjust_unheard(world, 3, 1.0, BY_POINTS)
    assert np.array_equal(world.points.position, before)


@pytest.mark.parametrize("broken", ["one sees nothing", "none sees anything", "two alike", "absurd depth"])
def test_what_is_degenerate_does_no_harm(broken: str) -> None:
    world, _ = bent()
    newest = [world.keyframes[k] for k in range(HEARD, HEARD + UNHEARD)]
    if broken == "two alike":
        newest[3].world_from_camera = newest[2].world_from_camera.copy()
    elif broken == "absurd depth":
        for keyframe in newest:
            keyframe.metres = np.full(len(keyframe.points), 1e-300)
    else:
        for keyframe in newest if broken.startswith("none") else newest[-1:]:
            keyframe.points[:] = -1
    assert adjust_unheard(world, 3, 1.0, BY_POINTS) == (broken != "none sees anything")
    for keyframe in newest[:-1] if broken != "none sees anything" else []:
        off = inverse(POSES[keyframe.id]) @ keyframe.world_from_camera
        assert np.linalg.norm(off[:3, 3]) < 0.01
    assert np.isfinite(world.points.position).all()


def test_keyframes_that_made_nothing_are_put_right_by_what_they_see() -> None:
    """As in a turn so fast that no second one has seen yet what each of them made."""
    world, _ = bent()
    for keyframe in world.keyframes.values():
        made = world.points.reference[world.points.rows(np.maximum(keyframe.points, 0))] >= HEARD
        keyframe.points[(keyframe.points >= 0) & made] = -1
    before = errors(world)
    assert adjust_unheard(world, 3, 1.0, BY_POINTS)
    assert max(errors(world)) < 0.2 * max(before)


def test_the_last_frame_moves_with_its_surroundings() -> None:
    world, _ = bent()
    newest = world.newest()
    last = TrackedFrame.of_keyframe(newest, 100)
    assert adjust_unheard(world, 3, 1.0, BY_POINTS, last)
    off = inverse(newest.world_from_camera) @ last.world_from_camera
    assert np.linalg.norm(off[:3, 3]) < 0.01
    assert rotation_angle(off[:3, :3]) < 0.005


def too_large(hears: bool, units_per_metre: float = 1.0, was_off: float = 0.0) -> float:
    """How far off (log) the size of a new part still is that was a fifth too large, the older being doubtful.

    The network is right about the new part; of the older one it said that all is ``was_off`` (log) nearer.
    """
    world, true = bent(drift=0.0)
    table = world.points
    table.log_depth_sigma[table.reference < HEARD] = 2.0
    for keyframe in world.keyframes.values():
        keypoints = keyframe.observed()
        places = np.array([true[p] for p in keyframe.points[keypoints].tolist()])
        depths = transform(inverse(keyframe.world_from_camera), places)[:, 2]
        keyframe.metres = np.zeros(len(keyframe.points))
        keyframe.metres[keypoints] = depths * hears
        if keyframe.id < HEARD:
            keyframe.metres *= np.exp(-was_off)
    at, new = world.keyframes[HEARD - 1].world_from_camera[:3, 3], table.reference >= HEARD
    table.position[new] += 0.2 * (table.position[new] - at)
    for k in range(HEARD, HEARD + UNHEARD):
        pose = world.keyframes[k].world_from_camera
        pose[:3, 3] += 0.2 * (pose[:3, 3] - at)
    for keyframe in world.keyframes.values():
        keyframe.world_from_camera[:3, 3] *= units_per_metre
    table.position *= units_per_metre
    adjust_unheard(world, 3, units_per_metre, BY_POINTS)
    ends = [k.world_from_camera[:3, 3] for k in (world.keyframes[HEARD], world.newest())]
    truth = units_per_metre * np.linalg.norm(POSES[-1][:3, 3] - POSES[HEARD][:3, 3])
    return abs(float(np.log(np.linalg.norm(ends[1] - ends[0]) / truth)))


@pytest.mark.parametrize("units_per_metre", [1.0, 2.0])
def test_the_network_says_how_large_what_is_new_is(units_per_metre: float) -> None:
    told = too_large(True, units_per_metre)
    assert told < 0.03
    assert too_large(False, units_per_metre) > 3.0 * told


def test_two_images_do_not_tell_how_far_off_a_network_is() -> None:
    world, _ = bent(drift=0.0)
    for keyframe in world.keyframes.values():
        keypoints, depths = world.depths_in(keyframe)
        keyframe.metres = np.zeros(len(keyframe.points))
        keyframe.metres[keypoints] = depths * np.exp(-0.7)
    held = list(world.keyframes.values())[:3]
    assert unheard._off(world, held, 1.0) == pytest.approx(0.7)
    assert unheard._off(world, held[:2], 1.0) == 0.0


def test_points_count_as_far_as_they_are_trusted_and_what_moves_is_not_doubtful_besides(monkeypatch) -> None:
    world, _ = bent()
    world.points.weight[:], world.points.log_depth_sigma[:] = 0.3, 0.5
    given = []
    monkeypatch.setattr(unheard, "adjust", lambda problem, *_: given.append(problem))
    assert not adjust_unheard(world, 3, 1.0, BY_POINTS)
    (problem,) = given
    assert set(problem.weight.tolist()) == {0.3}
    assert not problem.depth_error[: problem.free_points].any()
    assert np.abs(problem.depth_error[problem.free_points :]).max(axis=1).min() > 0.5


def test_a_network_that_was_off_has_less_of_a_say() -> None:
    assert too_large(True, was_off=2.0) > 2.0 * too_large(True)


@pytest.mark.parametrize("least", [3, 0])
def test_the_tracker_does_so_by_itself(least: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """A keyframe that was put aside comes back with the next ones, which no correction has known."""
    run = Run(tracker=Tracker(replace(CONFIG, keyframe_max_s=0.15, adjust_unheard=least)))
    frame, world = 0, run.tracker.world
    while len(run.keyframes) < 5:
        run.play(range(frame, frame + 1))
        frame, world = frame + 1, run.tracker.world
    world.heard = sorted(world.keyframes)[-4]
    monkeypatch.setattr(unheard, "LEAST_OLD", 2)
    astray = world.newest()
    there = astray.world_from_camera.copy()
    push = se3_exp(np.array([0.0, 0.03, 0.0, 0.0, 0.0, 0.0]))
    astray.world_from_camera = push @ there
    made = world.points.reference == astray.id
    world.points.position[made] = transform(push, world.points.position[made])
    while len(run.keyframes) < 6:
        run.feed(frame)
        frame += 1
    off = np.linalg.norm(astray.world_from_camera[:3, 3] - there[:3, 3])
    assert (off < 0.015) if least else (off > 0.029)


def test_a_correction_is_heard() -> None:
    world, _ = bent()
    world.heard = 1
    for based_on, heard in ((6, 6), (5, 6)):
        apply_correction(world, map_update(based_on), BY_POINTS, Parts())
        assert world.heard == heard


def test_of_a_map_that_the_backend_gave_all_is_heard() -> None:
    ring, mapper = Ring(), Mapper(BackendConfig(), use_depth=False)
    for _ in range(3):
        mapper.absorb(ring.keyframe())
    assert local_copy(mapper.world).heard == max(mapper.world.keyframes)
    assert LocalMap().heard == -1


def test_without_metric_factors_nothing_metric_is_adjusted() -> None:
    config = Config(tracking=TrackingConfig(adjust_unheard=4))
    assert tracking_of(config).adjust_unheard == 4
    assert tracking_of(replace(config, ablate=("depth_factor",))).adjust_unheard == 0
