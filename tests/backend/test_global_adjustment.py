"""All keyframes at once, against the truth."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import L

from prism_edge.backend import global_adjustment as module
from prism_edge.backend.global_adjustment import GlobalAdjustment, apply, choose_views
from prism_edge.backend.global_map import GlobalMap
from prism_edge.config import BackendConfig
from prism_edge.geometry.poses import from_rt, inverse, se3_exp, se3_log, transform
from tests.backend.ring import position_error
from tests.backend.world import Teller, check, depth_at_keypoints, poses_of
from tests.tracking.cloud import pose_at

CONFIG = BackendConfig()


def shaken(count: int = 8, sigma: float = 0.02) -> tuple[Teller, GlobalMap]:
    """Keyframes of a cloud, each put a little beside its place."""
    teller, world, rng = Teller(noise_px=0.3), GlobalMap(), np.random.default_rng(3)
    for i in range(count):
        world.absorb(teller.keyframe(pose_at(0.25 * i, 0.05 * i, 0.0, 0.0, -0.04 * i)))
    for k in list(world.keyframes)[1:]:
        keyframe = world.keyframes[k]
        keyframe.world_from_camera = keyframe.world_from_camera @ se3_exp(sigma * rng.normal(size=6))
    for point in world.points.values():
        point.position = point.position + 2 * sigma * rng.normal(size=3)
    return teller, world


def run(world: GlobalMap, config: BackendConfig = CONFIG):
    job = GlobalAdjustment(world, config, 1.0, use_depth=False)
    steps = 0
    while not job.step():
        steps += 1
        assert steps < 100
    return job.result()


def test_it_finds_the_truth_again():
    teller, world = shaken()
    poses = {k: keyframe.world_from_camera for k, keyframe in world.keyframes.items()}
    before = position_error(poses, teller.poses)
    adjusted = run(world)
    assert adjusted.error_after < 0.2 * adjusted.error_before
    assert adjusted.cpu_s > 0
    apply(world, adjusted, CONFIG)
    after = position_error({k: f.world_from_camera for k, f in world.keyframes.items()}, teller.poses)
    assert after < 0.2 * before
    check(world)


@pytest.mark.parametrize("measured", [True, False])
def test_what_a_sensor_measured_says_how_large_a_map_is(measured: bool):
    """By a network's depths, which aren't in it, the map has the unit that it had."""
    teller, world = Teller(), GlobalMap()
    for i in range(4):
        world.absorb(teller.keyframe(pose_at(0.25 * i, 0.05 * i)))
    for k, keyframe in world.keyframes.items():
        depths = transform(inverse(teller.poses[k]), teller.cloud.positions)[:, 2]
        keyframe.depths, keyframe.depth_sigma = np.zeros(len(keyframe.pixels)), 0.02 * measured
        for p, keypoint in keyframe.observed.items():
            keyframe.depths[keypoint] = depths[p]
        keyframe.world_from_camera = from_rt(teller.poses[k][:3, :3], 1.1 * teller.poses[k][:3, 3])
    for point in world.points.values():
        point.position = 1.1 * point.position
    job = GlobalAdjustment(world, CONFIG, 1.0, use_depth=True)
    while not job.step():
        pass
    way = np.linalg.norm(job.result().poses[3][:3, 3]) / np.linalg.norm(teller.poses[3][:3, 3])
    assert way == pytest.approx(1.0 if measured else 1.1, rel=0.01)


def test_it_says_how_wide_apart_the_rays_of_each_point_are_now():
    _, world = shaken()
    adjusted = run(world)
    wrong = {p for _, p in apply(world, adjusted, CONFIG)}
    centres = {k: keyframe.world_from_camera[:3, 3] for k, keyframe in world.keyframes.items()}
    sound = [p for p in adjusted.points if p not in wrong]
    assert len(sound) > 100
    for p in sound:
        point = world.points[p]
        first, *others = [point.position - centres[k] for k in sorted(point.keyframes)]
        angles = [np.arctan2(np.linalg.norm(np.cross(first, ray)), first @ ray) for ray in others]
        assert point.parallax_deg == pytest.approx(np.degrees(max(angles)), abs=1e-4)


def test_the_first_pose_and_the_unit_hold():
    _, world = shaken(sigma=0.0)
    for keyframe in world.keyframes.values():
        keyframe.world_from_camera = keyframe.world_from_camera.copy()
    adjusted = run(world)
    assert adjusted.poses[0] == pytest.approx(world.keyframes[0].world_from_camera, abs=1e-5)
    lengths = [
        np.linalg.norm(adjusted.poses[k][:3, 3]) / np.linalg.norm(world.keyframes[k].world_from_camera[:3, 3])
        for k in range(1, 8)
    ]
    assert np.median(lengths) == pytest.approx(1.0, abs=0.01)


def test_what_came_meanwhile_moves_along(monkeypatch):
    teller, world = shaken(sigma=0.0)
    job = GlobalAdjustment(world, CONFIG, 1.0, use_depth=False)
    late = teller.keyframe(pose_at(2.0, 0.4, 0.0, 0.0, -0.32))
    world.absorb(late)
    newer = [p for p, point in world.points.items() if point.keyframes == {8}]
    while not job.step():
        pass
    adjusted = job.result()
    motion = pose_at(1.0, 2.0, 3.0, 0.1, 0.2, 0.3)
    moved = replace(
        adjusted,
        poses={k: motion @ pose for k, pose in adjusted.poses.items()},
        points={p: motion[:3, :3] @ x + motion[:3, 3] for p, x in adjusted.points.items()},
    )
    monkeypatch.setattr(module, "keep_frame", lambda *_: False)  # which would bring all of it back
    apply(world, moved, CONFIG)
    off = se3_log(inverse(motion @ late.world_from_camera) @ world.keyframes[8].world_from_camera)
    assert np.abs(off).max() < 0.02
    for p in newer:
        true = motion[:3, :3] @ teller.cloud.positions[p] + motion[:3, 3]
        assert np.linalg.norm(world.points[p].position - true) < 0.1


def test_what_turns_everything_changes_nothing():
    """The frame is nobody's to change: an adjustment that only moved the map leaves it where it was."""
    _, world = shaken(sigma=0.0)
    adjusted = run(world)
    apply(world, adjusted, CONFIG)
    before = {k: keyframe.world_from_camera for k, keyframe in world.keyframes.items()}
    places = {p: point.position for p, point in world.points.items()}
    motion = pose_at(0.5, 0.2, -0.3, 0.1, 0.2, 0.3)
    turned = {k: motion @ pose for k, pose in before.items()}
    points = {p: motion[:3, :3] @ place + motion[:3, 3] for p, place in places.items()}
    apply(world, replace(adjusted, poses=turned, points=points), CONFIG)
    for k, pose in before.items():
        assert world.keyframes[k].world_from_camera == pytest.approx(pose, abs=1e-6)
    for p, place in places.items():
        assert world.points[p].position == pytest.approx(place, abs=1e-6)


def test_a_gross_outlier_is_found_and_dropped():
    _, world = shaken(sigma=0.002)
    point = next(p for p in world.points if len(world.points[p].keyframes) >= 5)
    keyframe = world.keyframes[sorted(world.points[point].keyframes)[2]]
    keyframe.pixels[keyframe.observed[point]] += 60.0
    wrong = apply(world, run(world), CONFIG)
    assert (keyframe.id, point) in wrong
    assert point not in keyframe.observed
    check(world)


def test_what_is_hundreds_of_pixels_off_pulls_at_nothing():
    _, world = shaken()
    _, without = shaken()
    keyframe = world.keyframes[0]
    astray = [p for p in sorted(keyframe.observed) if len(world.points[p].keyframes) >= 4][:2]
    for p in astray:
        keyframe.pixels[keyframe.observed[p]] += 300.0
        without.drop_observation(0, p)
    adjusted = run(world)
    for k, pose in run(without).poses.items():
        assert adjusted.poses[k] == pytest.approx(pose, abs=2e-4)  # where it stops
    assert {(0, p) for p in astray} <= set(apply(world, adjusted, CONFIG))


@pytest.mark.parametrize("depth", [1e-3, 1e-5])
@pytest.mark.parametrize("unit", [1.0, 1e-4])
def test_a_point_in_the_lens_keeps_nothing_from_moving(depth, unit, monkeypatch):
    """As of one that fits both pixels: where the camera, which backs up, was before.

    How near that is goes with the scene's depth, whatever the map's ``unit``.
    """
    teller, world, rng = Teller(noise_px=0.3), GlobalMap(), np.random.default_rng(3)
    for i in range(8):
        world.absorb(teller.keyframe(pose_at(0.02 * i, 0.05 * i, -0.25 * i, 0.0, -0.01 * i)))
    for k in list(world.keyframes)[1:]:
        world.keyframes[k].world_from_camera = world.keyframes[k].world_from_camera @ se3_exp(
            0.01 * rng.normal(size=6)
        )
    monkeypatch.setattr(module, "OBSERVATIONS", 1000)
    for keyframe in world.keyframes.values():
        keyframe.world_from_camera = keyframe.world_from_camera.copy()
        keyframe.world_from_camera[:3, 3] *= unit
    for point in world.points.values():
        point.position = unit * point.position
    without = run(world)
    first, last = world.keyframes[0], world.keyframes[7]
    p = next(p for p, point in world.points.items() if point.keyframes >= {0, 7})
    for k in world.points[p].keyframes - {0, 7}:
        del world.keyframes[k].observed[p]
    world.points[p].keyframes = {0, 7}
    in_lens = first.world_from_camera[:3, :3] @ (unit * depth * np.array([0.1, 0.1, 1.0]))
    world.points[p].position = first.world_from_camera[:3, 3] + in_lens
    for keyframe in (first, last):
        local = transform(inverse(keyframe.world_from_camera), world.points[p].position[None])[0]
        keyframe.pixels[keyframe.observed[p]] = keyframe.camera.to_pixels(local[None, :2] / local[2])[0]
    adjusted = run(world)
    assert adjusted.error_after < 1.05 * without.error_after
    assert p not in adjusted.points


def test_of_a_point_that_one_view_is_left_of_nothing_is_said():
    _, world = shaken(sigma=0.0)
    p = next(p for p, point in world.points.items() if len(point.keyframes) == 2)
    keyframe = world.keyframes[min(world.points[p].keyframes)]
    assert p in run(world).points
    keyframe.pixels[keyframe.observed[p]] += 300.0
    assert p not in run(world).points


@pytest.mark.parametrize("count", [1, 2])
def test_too_few_keyframes_are_left_alone(count):
    _, world = shaken(count, sigma=0.0)
    job = GlobalAdjustment(world, CONFIG, 1.0, use_depth=False)
    assert job.step()


def test_two_keyframes_at_one_pose_and_points_at_no_parallax():
    teller, world = Teller(noise_px=0.3), GlobalMap()
    for _ in range(4):
        world.absorb(teller.keyframe(pose_at(0.0)))
    adjusted = run(world)
    assert adjusted is None or all(np.isfinite(p).all() for p in adjusted.poses.values())


def in_one_room(count: int) -> GlobalMap:
    """Keyframes that see the same points, as those of a camera that stays where it is."""
    teller, world = Teller(noise_px=0.3), GlobalMap()
    for i in range(count):
        world.absorb(teller.keyframe(pose_at(0.02 * i, 0.01 * (i % 5), 0.0, 0.0, 0.0)))
    return world


def test_where_few_keyframes_see_a_point_all_their_views_are_used():
    world = in_one_room(module.MOST_VIEWS)
    for p, views in choose_views(world, sorted(world.points)).items():
        assert views == sorted(world.points[p].keyframes)


def test_of_many_views_of_a_point_an_even_choice_is_used_and_no_keyframe_goes_short():
    world = in_one_room(2 * module.MOST_VIEWS + 7)
    points = [p for p in sorted(world.points) if len(world.points[p].keyframes) >= 2]
    chosen = choose_views(world, points)
    most = max(len(point.keyframes) for point in world.points.values())
    assert most > 2 * module.MOST_VIEWS
    assert list(chosen) == points
    for p, views in chosen.items():
        seen_by = sorted(world.points[p].keyframes)
        assert views == sorted(set(views))
        assert set(views) <= set(seen_by)
        assert len(views) == min(len(seen_by), module.MOST_VIEWS)
        gaps = np.diff([seen_by.index(k) for k in views])
        assert gaps.max(initial=1) <= len(seen_by) // module.MOST_VIEWS + 1
    used = [sum(k in views for views in chosen.values()) for k in world.keyframes]
    assert min(used) >= 0.5 * np.median(used)


def test_what_all_points_tie_together_is_bounded(monkeypatch):
    """Their memory: every pair of a point's poses takes its place in a matrix."""
    world = in_one_room(2 * module.MOST_VIEWS)
    points = [p for p in sorted(world.points) if len(world.points[p].keyframes) >= 2]

    def pairs() -> int:
        return sum(len(views) ** 2 for views in choose_views(world, points).values())

    unbounded = pairs()
    monkeypatch.setattr(module, "MOST_PAIRS", unbounded // 4)
    assert 0.8 * module.MOST_PAIRS < pairs() <= module.MOST_PAIRS
    monkeypatch.setattr(module, "MOST_PAIRS", 1)
    chosen = choose_views(world, points)
    used = np.array([len(views) for views in chosen.values()])
    assert np.median(used) == module.FEWEST_VIEWS
    assert used.max() < module.MOST_VIEWS  # more than the fewest are for keyframes that would go short


def test_a_keyframe_that_sees_little_keeps_what_it_sees(monkeypatch):
    monkeypatch.setattr(module, "MOST_VIEWS", 3)
    world = in_one_room(40)
    for k in (5, 17):
        for p in sorted(world.keyframes[k].observed)[module.FEWEST_SEEN + 5 :]:
            world.drop_observation(k, p)
    points = [p for p in sorted(world.points) if len(world.points[p].keyframes) >= 2]
    chosen = choose_views(world, points)
    for k, keyframe in world.keyframes.items():
        has = len(keyframe.observed.keys() & chosen.keys())
        assert sum(k in views for views in chosen.values()) >= min(has, module.FEWEST_SEEN)


def test_it_finds_the_truth_again_with_some_of_the_views(monkeypatch):
    monkeypatch.setattr(module, "MOST_VIEWS", 4)
    teller, world = shaken(12)
    before = position_error(poses_of(world), teller.poses)
    adjusted = run(world)
    apply(world, adjusted, CONFIG)
    assert position_error(poses_of(world), teller.poses) < 0.3 * before
    check(world)


@pytest.mark.parametrize("said_k1", [None, 0.0])
def test_a_lens_by_which_a_point_got_behind_a_camera_is_none(said_k1):
    """Its factor counts such a point as seen exactly; a plain reprojection puts a price on it."""
    _, world = shaken(sigma=0.0)
    for point in world.points.values():
        point.parallax_deg = 5.0
    job = GlobalAdjustment(world, CONFIG, 1.0, use_depth=False, said_k1=said_k1)
    while not job.step():
        pass
    assert job.result() is not None
    values = gtsam.Values(job._optimiser.values())
    everywhere = next(p for p in job._points if len(world.points[p].keyframes) == len(world.keyframes))
    aside = next(
        place
        for place in (world.keyframes[0].world_from_camera @ (x, 0.0, -0.01, 1.0) for x in (-20.0, 20.0))
        if sum((inverse(k.world_from_camera) @ place)[2] <= 0.0 for k in world.keyframes.values()) == 1
    )
    values.update(L(everywhere), aside[:3])
    job._optimiser = SimpleNamespace(values=lambda: values)
    assert (job.result() is None) == (said_k1 is not None)


def test_of_each_part_the_first_pose_holds():
    """Where parts lie beside each other nobody knows: neither is free to wander."""
    _, world = shaken(5)
    other, off = Teller(seed=1, noise_px=0.3, first=100), pose_at(0.1, 0.05, 0.0, 0.02, 0.03)
    for i in range(5):
        message = other.keyframe(pose_at(0.25 * i, 0.05 * i, 0.0, 0.0, -0.04 * i))
        ids = {"points": message.points + 10_000, "new_points": message.new_points + 10_000}
        world.absorb(replace(message, **ids))
    for k in range(101, 105):
        world.keyframes[k].world_from_camera = off @ world.keyframes[k].world_from_camera
    first = {k: world.keyframes[k].world_from_camera.copy() for k in (0, 100)}
    job = GlobalAdjustment(world, CONFIG, 1.0, False, parts=[set(range(5)), set(range(100, 105))])
    while not job.step():
        pass
    for k, pose in first.items():
        # all are brought to the one unit, as seen from the map's first pose
        assert job.result().poses[k] == pytest.approx(pose, abs=1e-3 if k else 1e-5)


def test_a_point_that_two_parts_see_goes_with_the_part_that_saw_it_first():
    _, world = shaken(sigma=0.0)
    earlier, later = set(range(4)), set(range(4, 8))
    job = GlobalAdjustment(world, CONFIG, 1.0, False, parts=[earlier, later])
    first = {p: min(world.points[p].keyframes) for p in job._points}
    both = [p for p, k in first.items() if k in earlier and world.points[p].keyframes & later]
    assert len(both) > 10
    for part in (earlier, later):
        assert sorted(job._owned(part)) == sorted(p for p, k in first.items() if k in part)


@pytest.mark.parametrize(("factor", "taken"), [(1.5, True), (3.0, False)])
def test_a_map_that_doubled_or_halved_is_not_taken(factor, taken):
    """A sensor's depth that says so is of something else."""
    teller, world = shaken(sigma=0.0)
    depth_at_keypoints(world, teller.cloud, teller.poses, factor)
    for keyframe in world.keyframes.values():
        keyframe.depth_sigma = 0.02
    job = GlobalAdjustment(world, replace(CONFIG, huber_depth_m=100.0), 1.0, use_depth=True)
    while not job.step():
        pass
    assert (job.result() is not None) == taken


def test_a_point_that_had_no_part_in_it_goes_with_its_first_viewer(monkeypatch):
    _, world = shaken(sigma=0.0)
    adjusted = run(world)
    left_out = next(p for p in adjusted.points if len(world.points[p].keyframes) >= 4)
    viewers, place = sorted(world.points[left_out].keyframes), world.points[left_out].position.copy()
    before = {k: world.keyframes[k].world_from_camera.copy() for k in viewers}
    poses = {k: pose_at(0.1 * k) @ pose for k, pose in adjusted.poses.items()}
    monkeypatch.setattr(module, "keep_frame", lambda *_: False)
    apply(world, replace(adjusted, poses=poses, points={}), CONFIG)
    motion = poses[viewers[0]] @ inverse(before[viewers[0]])
    expected = transform(motion, place[None])[0]
    assert world.points[left_out].position == pytest.approx(expected)


def test_where_a_sensor_has_no_depth_the_image_alone_counts():
    """Its holes are zeros: no distance, and none that has a logarithm."""
    teller, world = shaken()
    depth_at_keypoints(world, teller.cloud, teller.poses)
    for keyframe in world.keyframes.values():
        keyframe.depth_sigma = 0.02
        keyframe.depths[::3] = 0.0
    poses = {k: keyframe.world_from_camera for k, keyframe in world.keyframes.items()}
    before = position_error(poses, teller.poses)
    job = GlobalAdjustment(world, CONFIG, 1.0, use_depth=True)
    while not job.step():
        pass
    assert position_error(job.result().poses, teller.poses) < 0.2 * before
