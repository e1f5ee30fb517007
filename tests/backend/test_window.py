"""Choice of the window and its bundle adjustment, on worlds whose truth is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from gtsam.symbol_shorthand import L

from prism_edge.backend import settling
from prism_edge.backend.global_adjustment import GlobalAdjustment
from prism_edge.backend.global_map import GlobalMap, GlobalPoint
from prism_edge.backend.window import (
    Window,
    choose_window,
    outliers,
    placed_elsewhere,
    solve,
    widest_parallax,
)
from prism_edge.config import BackendConfig
from prism_edge.geometry.poses import inverse, scaled, se3_exp, se3_log
from tests.backend.world import Teller, depth_at_keypoints
from tests.tracking.cloud import pose_at

CONFIG = BackendConfig(observations=300)
POSES = [pose_at(0.2 * i, 0.03 * (i % 3), 0.02 * i, 0.0, -0.03 * i) for i in range(6)]


def world_of(poses=POSES, noise_px=0.0, count=250) -> tuple[GlobalMap, Teller]:
    teller, world = Teller(count, noise_px=noise_px), GlobalMap()
    for pose in poses:
        world.absorb(teller.keyframe(pose))
    for k, pose in enumerate(poses):
        world.keyframes[k].world_from_camera = pose.copy()
    for p, point in world.points.items():
        point.position = teller.cloud.positions[p].copy()
    depth_at_keypoints(world, teller.cloud, poses)
    return world, teller


def perturb(world: GlobalMap, seed: int = 0, pose_sigma: float = 0.02, point_sigma: float = 0.05) -> None:
    rng = np.random.default_rng(seed)
    for k in sorted(world.keyframes)[1:]:
        keyframe = world.keyframes[k]
        twist = rng.normal(0, 1, 6) * ([pose_sigma] * 3 + [pose_sigma / 4] * 3)
        keyframe.world_from_camera = keyframe.world_from_camera @ se3_exp(twist)
    for point in world.points.values():
        point.position = point.position + rng.normal(0, point_sigma, 3)


def worst(solution, teller) -> float:
    return max(
        np.linalg.norm((inverse(teller.poses[k]) @ pose)[:3, 3]) for k, pose in solution.poses.items()
    )


def test_exactly_one_pose_is_held_while_the_window_is_the_whole_map():
    world, _ = world_of()
    window = choose_window(world, 5, CONFIG)
    assert window.held == [0]
    assert window.free == [1, 2, 3, 4, 5]


def test_with_more_map_than_window_older_keyframes_hold_it():
    world, _ = world_of([pose_at(0.1 * i) for i in range(12)])
    window = choose_window(world, 11, replace(CONFIG, window=4, fixed=3))
    assert 11 in window.free
    assert len(window.free) == 4
    assert len(window.held) == 3
    assert not set(window.free) & set(window.held)
    # The free ones are those that share most with the newest.
    shared = [k for k, _ in world.covisible(11)[:3]]
    assert set(window.free) == {11, *shared}


def test_what_stands_in_for_an_older_keyframe_moves_none_of_them():
    world, teller = world_of([pose_at(0.1 * i) for i in range(12)], noise_px=0.5)
    for k in (8, 9, 10, 11):
        world.keyframes[k].stands_in = True
    for k in range(8):  # share less with it than they do
        for p in list(world.keyframes[k].observed)[::5]:
            world.drop_observation(k, p)
    world.keyframes[11].world_from_camera = pose_at(1.12, 0.01)
    config = replace(CONFIG, window=4, fixed=3)
    window = choose_window(world, 11, config)
    assert window.free == [11]
    assert len(window.held) == 3
    assert max(window.held) < 8, "nor is it held by others that stand in"
    solution = solve(world, window, config, 1.0, use_depth=True)
    assert list(solution.poses) == [11]
    assert worst(solution, teller) < 0.01  # it began 22 mm off


def test_points_of_the_window_are_seen_twice_in_it_and_not_too_many():
    world, _ = world_of([pose_at(0.1 * i) for i in range(8)])
    window = choose_window(world, 7, replace(CONFIG, window=3, fixed=2, observations=40))
    members = {*window.free, *window.held}
    assert window.points
    for p in window.points:
        assert len(world.points[p].keyframes & members) >= 2
    assert len(window.points) <= 40 * len(window.free)
    assert window.points == sorted(window.points)


def test_of_a_keyframe_s_points_those_join_that_most_of_the_window_see():
    world, _ = world_of([pose_at(0.3 * i) for i in range(8)])
    window = choose_window(world, 2, replace(CONFIG, window=4, observations=20))
    seen = {p: sum(p in world.keyframes[k].observed for k in window.free) for p in world.points}
    assert len({seen[p] for p in world.keyframes[2].observed}) > 1, "there is a choice"
    assert {seen[p] for p in window.points} == {len(window.free)} == {4}


def test_perturbed_poses_and_points_come_back():
    world, teller = world_of()
    perturb(world)
    solution = solve(world, choose_window(world, 5, CONFIG), CONFIG, 1.0, use_depth=True)
    assert set(solution.poses) == {1, 2, 3, 4, 5}
    assert worst(solution, teller) < 0.01  # it began 22 mm off
    for k, pose in solution.poses.items():
        assert np.abs(se3_log(inverse(teller.poses[k]) @ pose)[3:]).max() < 0.002
    off = [np.linalg.norm(x - teller.cloud.positions[p]) for p, x in solution.points.items()]
    assert np.median(off) < 0.01
    assert not solution.outliers
    assert 0 < solution.iterations <= CONFIG.iterations


def test_noise_of_a_pixel_leaves_errors_of_its_size():
    world, teller = world_of(noise_px=0.7)
    perturb(world)
    solution = solve(world, choose_window(world, 5, CONFIG), CONFIG, 1.0, use_depth=True)
    assert worst(solution, teller) < 0.03


def test_held_poses_do_not_move():
    world, _ = world_of([pose_at(0.1 * i) for i in range(8)])
    window = choose_window(world, 7, replace(CONFIG, window=3, fixed=3))
    before = {k: world.keyframes[k].world_from_camera.copy() for k in window.held}
    perturb(world, pose_sigma=0.0)
    solution = solve(world, window, CONFIG, 1.0, use_depth=True)
    assert not set(solution.poses) & set(window.held)
    for k, pose in before.items():
        assert np.array_equal(world.keyframes[k].world_from_camera, pose)


def grown(factor: float, depth_factor: float = 1.0) -> tuple[GlobalMap, Teller]:
    """A consistent world whose lengths are ``factor`` times what depth says."""
    world, teller = world_of()
    for keyframe in world.keyframes.values():
        keyframe.world_from_camera = scaled(keyframe.world_from_camera, factor)
    for point in world.points.values():
        point.position = point.position * factor
    depth_at_keypoints(world, teller.cloud, teller.poses, depth_factor)
    return world, teller


def size(solution) -> float:
    return float(np.linalg.norm(solution.poses[5][:3, 3]) / np.linalg.norm(POSES[5][:3, 3]))


def test_metric_depth_pins_the_scale_when_one_pose_is_held():
    often = replace(CONFIG, iterations=100)
    for factor in (0.9, 1.15):
        world, _ = grown(factor)
        window = choose_window(world, 5, often)
        assert len(window.held) == 1
        free = solve(world, window, often, 1.0, use_depth=False)
        assert size(free) == pytest.approx(factor, rel=1e-3), "reprojections alone keep any scale"
        pinned = solve(world, window, often, 1.0, use_depth=True)
        assert size(pinned) == pytest.approx(1.0, abs=0.02)


def test_wrong_observations_are_named_and_do_no_harm():
    world, teller = world_of(noise_px=0.3)
    rng = np.random.default_rng(1)
    wrong = set()
    for k in (2, 3, 4, 5):
        keyframe = world.keyframes[k]
        for p in rng.permutation(sorted(keyframe.observed))[:10].tolist():
            if len(world.points[p].keyframes) >= 4:
                keyframe.pixels[keyframe.observed[p]] += rng.choice((-1, 1), 2) * 60.0
                wrong.add((k, p))
    perturb(world, pose_sigma=0.01, point_sigma=0.02)
    solution = solve(world, choose_window(world, 5, CONFIG), CONFIG, 1.0, use_depth=True)
    assert worst(solution, teller) < 0.03
    assert len(wrong & set(solution.outliers)) > 0.95 * len(wrong)
    assert len(set(solution.outliers) - wrong) < 0.03 * sum(len(k.observed) for k in world.keyframes.values())


def test_of_right_observations_one_in_a_hundred_is_beyond_the_bound():
    world, _ = world_of(count=1000)
    rng = np.random.default_rng(2)
    for keyframe in world.keyframes.values():
        sigma = CONFIG.pixel_sigma * keyframe.sigmas[:, None]
        keyframe.pixels = keyframe.pixels + sigma * rng.normal(size=keyframe.pixels.shape)
    seen = [(k, p, i) for k, keyframe in world.keyframes.items() for p, i in keyframe.observed.items()]
    wrong = outliers(world, {}, {p: point.position for p, point in world.points.items()}, seen, CONFIG)
    assert len(wrong) / len(seen) == pytest.approx(0.01, abs=0.004)


def test_nothing_to_optimise_is_none():
    world, _ = world_of(POSES[:1])
    window = choose_window(world, 0, CONFIG)
    assert (window.free, window.held) == ([], [0])
    assert solve(world, window, CONFIG, 1.0, use_depth=True) is None
    world, _ = world_of(POSES[:3], count=6)
    assert solve(world, choose_window(world, 2, CONFIG), CONFIG, 1.0, use_depth=True) is None


@pytest.mark.parametrize("place", [np.nan, np.inf])
def test_places_that_are_no_numbers_give_none(place):
    world, _ = world_of()
    window = choose_window(world, 5, CONFIG)
    for point in world.points.values():
        point.position = np.full(3, place)
    assert solve(world, window, CONFIG, 1.0, use_depth=False) is None


def test_points_on_a_camera_or_behind_it_give_numbers_or_none():
    world, _ = world_of()
    rng = np.random.default_rng(0)
    for p in rng.permutation(sorted(world.points))[:40].tolist():
        world.points[p].position = np.array([0.0, 0.0, -2.0])
    for p in rng.permutation(sorted(world.points))[:5].tolist():
        world.points[p].position = POSES[3][:3, 3].copy()
    solution = solve(world, choose_window(world, 5, CONFIG), CONFIG, 1.0, use_depth=True)
    if solution is not None:
        assert all(np.isfinite(v).all() for v in (*solution.poses.values(), *solution.points.values()))


def test_one_bad_point_does_not_stop_the_rest():
    world, teller = world_of()
    perturb(world)
    world.points[max(world.points)].position = np.array([0.0, 0.0, -3.0])
    solution = solve(world, choose_window(world, 5, CONFIG), CONFIG, 1.0, use_depth=True)
    assert worst(solution, teller) < 0.005


def test_a_point_only_the_window_s_other_members_see_is_left_out():
    world, _ = world_of()
    world.points[10**6] = GlobalPoint(np.ones(3), {0})
    world.keyframes[0].observed[10**6] = 0
    assert 10**6 not in choose_window(world, 5, CONFIG).points


def spot_and_walk(noise_px: float = 0.7) -> tuple[GlobalMap, Teller, set[int]]:
    """A walk of 1.5 m, then forty keyframes within a centimetre; and the points that the walk places."""
    rng = np.random.default_rng(0)
    walk = [pose_at(0.25 * i - 0.75, 0.05 * i) for i in range(7)]
    spot = [se3_exp(np.concatenate([rng.normal(0, 0.004, 3), rng.normal(0, 0.004, 3)])) for _ in range(40)]
    world, teller = world_of(walk + spot, noise_px)
    for keyframe in world.keyframes.values():
        keyframe.depths = None
    places = {p: point.position for p, point in world.points.items()}
    for p, angle in widest_parallax(world, places).items():
        world.points[p].parallax_deg = angle
    placed = {p for p, x in world.points.items() if len(x.keyframes & set(range(len(walk)))) >= 3}
    return world, teller, placed


def test_coming_by_one_spot_again_and_again_leaves_the_map_as_it_is():
    """Those that share most with the newest all stand beside it: among themselves they place nothing."""
    world, teller, placed = spot_and_walk()
    for k in range(20):
        solution = solve(world, choose_window(world, 46 - k % 8, CONFIG), CONFIG, 1.0, True)
        for number, pose in solution.poses.items():
            world.keyframes[number].world_from_camera = pose
        for p, position in solution.points.items():
            world.points[p].position = position
            world.points[p].parallax_deg = solution.parallax_deg[p]
    off = [np.linalg.norm(world.points[p].position - teller.cloud.positions[p]) for p in placed]
    assert len(placed) > 150
    assert np.median(off) < 0.05
    assert np.quantile(off, 0.95) < 0.3
    assert worst(solution, teller) < 0.02


def test_held_keyframes_look_from_more_than_one_place():
    world, _, _ = spot_and_walk()
    window = choose_window(world, 46, CONFIG)
    assert sum(k < 7 for k in window.held) >= 5
    alone, _ = world_of([pose_at(0.0)] * 30)
    assert len(choose_window(alone, 29, CONFIG).held) == CONFIG.fixed


def test_a_point_that_others_place_stays_where_it_is_in_a_window_that_cannot():
    world, _, placed = spot_and_walk()
    seen = sorted(p for p in placed if len(world.points[p].keyframes & set(range(20, 40))) >= 2)
    window = Window(list(range(20, 32)), list(range(32, 40)), seen)
    kept = placed_elsewhere(world, window)
    assert kept >= {p for p in seen if world.points[p].parallax_deg >= 10.0}
    before = {p: world.points[p].position.copy() for p in kept}
    solution = solve(world, window, CONFIG, 1.0, True)
    assert max(np.linalg.norm(solution.points[p] - x) for p, x in before.items()) < 1e-4
    assert not placed_elsewhere(world, Window(list(range(1, 7)), [7, 8], seen))


def test_one_point_that_has_run_away_turns_no_window():
    """Its rays hardly cross, so they count as rays; one of them is of something else."""
    world, teller = world_of()
    gone = max(world.points, key=lambda p: (len(world.points[p].keyframes), -p))
    eye = world.keyframes[5].world_from_camera[:3, 3]
    world.points[gone].position = eye + 1000.0 * (world.points[gone].position - eye)
    world.points[gone].parallax_deg = 0.05
    first = world.keyframes[min(world.points[gone].keyframes)]
    first.pixels[first.observed[gone]] += (60.0, -40.0)
    solution = solve(world, choose_window(world, 5, CONFIG), CONFIG, 1.0, True)
    assert worst(solution, teller) < 0.005
    assert (min(world.points[gone].keyframes), gone) in solution.outliers


@pytest.mark.parametrize("iterations", [1, 2, 4, 5])
def test_few_iterations_are_made_all_the_same(iterations):
    """Those kept for a second round must not be all there are."""
    world, teller = world_of()
    perturb(world)  # by 5 cm and less
    config = replace(CONFIG, iterations=iterations)
    solution = solve(world, choose_window(world, 5, config), config, 1.0, True)
    assert 1 <= solution.iterations <= iterations
    assert worst(solution, teller) < 0.01


def flattened() -> tuple[GlobalMap, Teller]:
    """A map without fault whose far points rays hardly place; the network says that they are near."""
    world, teller = world_of([pose_at(0.02 * i) for i in range(8)], noise_px=0.3)
    widest = widest_parallax(world, {p: point.position for p, point in world.points.items()})
    for p, point in world.points.items():
        point.parallax_deg = widest[p]
    for keyframe in world.keyframes.values():
        keyframe.depths = 2.0 * (keyframe.depths / 2.0) ** 0.6
    return world, teller


def drawn_in(found: dict[int, np.ndarray], teller: Teller) -> float:
    """Mean log of how far away the far points are, over how far they should be."""
    far = {p: x for p, x in found.items() if teller.cloud.positions[p][2] > 4.0}
    assert len(far) > 50
    return float(np.mean([np.log(x[2] / teller.cloud.positions[p][2]) for p, x in far.items()]))


def test_a_network_that_flattens_what_it_sees_does_not_draw_far_points_in():
    world, teller = flattened()
    config = replace(CONFIG, window=4, fixed=3)
    window = choose_window(world, 7, config)
    assert len(window.held) > 1, "scale is held"
    solution = solve(world, window, config, 1.0, use_depth=True)
    assert abs(drawn_in(solution.points, teller)) < 0.05


def test_nor_does_it_when_all_keyframes_are_adjusted():
    world, teller = flattened()
    adjustment = GlobalAdjustment(world, CONFIG, 1.0, use_depth=True)
    while not adjustment.step():
        pass
    way = np.linalg.norm(adjustment.result().poses[7][:3, 3] - adjustment.result().poses[0][:3, 3])
    points = {p: 0.14 / way * x for p, x in adjustment.result().points.items()}  # as large as the truth
    assert abs(drawn_in(points, teller)) < 0.05


@pytest.mark.parametrize("iterations", [CONFIG.iterations, 2])
def test_rays_are_weighed_anew_where_their_points_were_at_other_ranges(iterations, monkeypatch):
    """Their noise goes with the range: what a solve ends with must fit what it was whitened by."""
    world, _ = world_of()
    for p, point in world.points.items():
        point.parallax_deg = 1.0  # all count as rays
        nearest = world.keyframes[min(point.keyframes)].world_from_camera[:3, 3]
        point.position = nearest + (1.3 if p % 2 else 0.8) * (point.position - nearest)
    rounds, made = [], settling.with_rays

    def with_rays(world, problem, values):
        rounds.append((problem, values))
        return made(world, problem, values)

    monkeypatch.setattr(settling, "with_rays", with_rays)
    config = replace(CONFIG, iterations=iterations, fixed=1)  # by which this is no new ground
    solution = solve(world, choose_window(world, 5, config), config, 1.0, True)
    (problem, whitened_at), rays = rounds[-1], rounds[-1][0].rays
    poses = {k: keyframe.world_from_camera for k, keyframe in world.keyframes.items()} | solution.poses
    ended = [np.linalg.norm(solution.points[ray.point] - poses[ray.keyframe][:3, 3]) for ray in rays]
    assert len(rays) > 100
    moved = any(np.any(at != whitened_at.atPoint3(L(p))) for p, at in solution.points.items())
    assert moved or iterations > 2, "the second of two is for them"
    assert np.median(np.abs(np.log(ended / settling.ranges_of(problem, whitened_at)))) < settling.RANGE_CHANGE
