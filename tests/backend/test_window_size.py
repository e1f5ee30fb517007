"""Whose size a window's keyframes have: that of held poses, a network's, or a sensor's."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import X

from prism_edge.backend import window as module
from prism_edge.backend.global_map import GlobalKeyframe, GlobalMap
from prism_edge.backend.sizes import FEW, SHARE, Size, astray, sizes
from prism_edge.backend.ties import at_one_spot, median_range, untied
from prism_edge.backend.window import Window, placed_elsewhere, solve
from prism_edge.geometry.poses import inverse, scaled, transform
from tests.backend.test_window import CONFIG, grown, world_of
from tests.backend.world import depth_at_keypoints
from tests.tracking.cloud import CAMERA, pose_at


def turned_away(factor: float, depth_factor: float = 1.0) -> tuple[GlobalMap, Window]:
    """Four keyframes that drive off after eight on the spot, on new ground ``factor`` times too large."""
    spot = [pose_at(0.0, 0.0, 0.0, 0.0, 0.02 * i) for i in range(8)]
    drive = [pose_at(0.1 * i, 0.02 * i, 0.05 * i) for i in range(1, 5)]
    world, teller = world_of(spot + drive)
    depth_at_keypoints(world, teller.cloud, teller.poses, depth_factor)
    for keyframe in world.keyframes.values():
        keyframe.world_from_camera = scaled(keyframe.world_from_camera, factor)
        keyframe.depth_units = 1.0
    for point in world.points.values():
        point.position, point.parallax_deg = factor * point.position, 0.5
    points = sorted(p for p, point in world.points.items() if len(point.keyframes) >= 2)
    return world, Window([8, 9, 10, 11], list(range(8)), points)


def driven(solution) -> float:
    """How far the camera drove, over how far it did."""
    return float(np.linalg.norm(solution.poses[11][:3, 3]) / np.linalg.norm([0.4, 0.08, 0.2]))


@pytest.mark.parametrize("factor", [0.6, 1.5])
def test_after_a_turn_on_the_spot_the_network_says_how_large_the_new_ground_is(factor):
    """Eight poses are held, and place nothing among them: all lengths could be others."""
    often = replace(CONFIG, iterations=100)
    world, window = turned_away(factor)
    assert untied(world, window.held, window.free, window.points) == window.free
    assert driven(solve(world, window, often, 1.0, use_depth=False)) == pytest.approx(factor, rel=0.01)
    assert driven(solve(world, window, often, 1.0, use_depth=True)) == pytest.approx(1.0, abs=0.03)
    # In a map whose unit is half a metre all is twice as large.
    assert driven(solve(world, window, often, 2.0, use_depth=True)) == pytest.approx(2.0, abs=0.06)


def strayed(factor: float, step: float) -> tuple[GlobalMap, Window]:
    """The same, its held poses a ``step`` aside of each other and turned back, as if nothing had moved."""
    world, window = turned_away(factor)
    for k in window.held:
        aside = step * factor * (k - 3.5)
        turned_back = pose_at(aside, 0.0, 0.0, 0.0, -aside / median_range(world, k))
        world.keyframes[k].world_from_camera = world.keyframes[k].world_from_camera @ turned_back
    assert at_one_spot(world, window.held)
    return world, window


@pytest.mark.parametrize("factor", [0.6, 1.5])
def test_small_ways_between_poses_held_at_one_spot_are_no_measure(factor):
    world, window = strayed(factor, 0.006)
    solution = solve(world, window, replace(CONFIG, iterations=100), 1.0, use_depth=True)
    assert driven(solution) == pytest.approx(1.0, abs=0.03)  # were they held as firmly as others: 0.83, 1.37
    assert set(solution.poses) == set(window.free)
    assert solution.outliers == []


@pytest.mark.parametrize("factor", [0.6, 1.5])
def test_what_they_see_is_judged_from_where_they_would_stand(factor):
    """From where they are held in the map, a hundred right observations would be outliers."""
    world, window = strayed(factor, 0.012)
    assert solve(world, window, replace(CONFIG, iterations=100), 1.0, use_depth=True).outliers == []


def test_of_those_the_first_stays_and_the_others_nearly():
    world, window = turned_away(1.0)
    graph = module.assemble(world, window, CONFIG, 1.0, use_depth=True, use_rays=True).graph
    factors = [graph.at(i) for i in range(graph.size())]
    firm = {f.keys()[0]: f for f in factors if isinstance(f, gtsam.PriorFactorPose3)}
    assert list(firm) == [X(k) for k in window.held]
    spread = [f.noiseModel().sigmas().max() for f in firm.values()]
    assert spread[0] < 1e-5
    assert min(spread[1:]) > 1e-3
    # Where nothing asks how large the ground is, nor where a way between those held can say it.
    beside, _ = tied_by(world, window, 1, 1.0)
    assert untied(world, beside.held, beside.free, beside.points) == beside.free
    for case, use_depth in ((window, False), (beside, True)):
        firmly = module.assemble(world, case, CONFIG, 1.0, use_depth, use_rays=True)
        assert set(firmly.standing) == set(case.held)


def test_a_network_that_hardly_tells_near_from_far_says_more_than_nothing():
    """Beside nothing else its images still have a size, if a vague one."""
    world, window = turned_away(1.5)
    rng = np.random.default_rng(0)
    for k in window.free:
        depths = world.keyframes[k].depths
        told = depths > 0
        depths[told] = np.median(depths[told]) * np.exp(rng.normal(0.0, 0.4, told.sum()))
    shown = {k: sorted(world.keyframes[k].observed.keys() & set(window.points)) for k in window.free}
    assert sizes(world, window.free, shown) == []
    votes = sizes(world, window.free, shown, any_at_all=True)
    assert [vote.keyframe for vote in votes] == window.free
    assert all(0.8 < vote.sigma < 2.0 for vote in votes)
    often = replace(CONFIG, iterations=100)
    assert driven(solve(world, window, often, 1.0, use_depth=True)) == pytest.approx(1.0, abs=0.15)


AWAY = 12  # a keyframe held elsewhere


def tied_by(world: GlobalMap, window: Window, count: int, size: float) -> tuple[Window, list[int]]:
    """A keyframe far from the spot sees ``count`` points as if all there were of another ``size``."""
    points = [p for p in window.points if world.points[p].keyframes >= {8, 9, 10, 11}][:count]
    assert len(points) == count
    places = size * np.array([world.points[p].position for p in points])
    pose = pose_at(-2.0, 0.3, 1.0)
    pixels = CAMERA.project(transform(inverse(pose), places))
    world.keyframes[AWAY] = GlobalKeyframe(AWAY, AWAY, CAMERA, pose, pixels, np.ones(count), {})
    for keypoint, (p, place) in enumerate(zip(points, places, strict=True)):
        world.observe(AWAY, p, keypoint)
        world.points[p].position, world.points[p].parallax_deg = place, 40.0
    return Window(window.free, [*window.held, AWAY], window.points), points


@pytest.mark.parametrize("size", [0.3, 0.4, 2.5])
def test_two_wrong_matches_do_not_say_how_large_new_ground_is(size):
    """They agree with whatever they make of it, and no other point says otherwise."""
    world, window = turned_away(1.0)
    window, points = tied_by(world, window, 2, size)
    assert untied(world, window.held, window.free, window.points) == window.free
    solution = solve(world, window, replace(CONFIG, iterations=100), 1.0, use_depth=True)
    assert driven(solution) == pytest.approx(1.0, abs=0.05)
    assert {(AWAY, p) for p in points} <= set(solution.outliers)


def test_nor_where_they_were_matched_outside_of_the_window():
    """There they would be held where those keyframes have them."""
    world, window = turned_away(1.0)
    _, points = tied_by(world, window, 2, 0.4)
    beside = pose_at(2.0, -0.3, 1.0)
    places = np.array([world.points[p].position for p in points])
    pixels = CAMERA.project(transform(inverse(beside), places))
    world.keyframes[AWAY + 1] = GlobalKeyframe(AWAY + 1, AWAY + 1, CAMERA, beside, pixels, np.ones(2), {})
    for keypoint, p in enumerate(points):
        world.observe(AWAY + 1, p, keypoint)
        world.points[p].parallax_deg = 170.0
    assert set(points) <= placed_elsewhere(world, window)
    solution = solve(world, window, replace(CONFIG, iterations=100), 1.0, use_depth=True)
    assert driven(solution) == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize(("left_out", "is_held"), [(11, True), (0, False)])
def test_a_point_stays_where_others_have_it_unless_the_new_ground_keeps_it(left_out, is_held, monkeypatch):
    world, window = turned_away(1.0)
    p = next(p for p in window.points if {0, 11} <= world.points[p].keyframes)
    monkeypatch.setattr(module, "placed_elsewhere", lambda *_: {p})
    monkeypatch.setattr(module, "astray", lambda *_: {(left_out, p)})
    graph = module.assemble(world, window, CONFIG, 1.0, use_depth=True, use_rays=True).graph
    kinds = [type(graph.at(i)).__name__ for i in range(graph.size())]
    assert ("PriorFactorPoint3" in kinds) == is_held


def test_a_few_right_ones_do_for_all_that_a_network_says():
    world, window = turned_away(1.0, depth_factor=1.5)
    often = replace(CONFIG, iterations=100)
    assert driven(solve(world, window, often, 1.0, use_depth=True)) == pytest.approx(1.5, abs=0.05)
    window, points = tied_by(world, window, 5, 1.0)
    solution = solve(world, window, often, 1.0, use_depth=True)
    assert driven(solution) == pytest.approx(1.0, abs=0.05)
    assert not {(AWAY, p) for p in points} & set(solution.outliers)


def asked(world: GlobalMap, told: set[int], sigma: float = 0.2, log_units: float = 0.0):
    votes = [Size(k, 0.0, sigma, {}) for k in sorted(told)]
    return astray(world, told, votes, sorted(world.points), log_units)


def test_a_point_that_one_side_sees_once_is_left_to_the_other():
    world, window = turned_away(1.0)
    window, (p,) = tied_by(world, window, 1, 0.4)
    point, told = world.points[p], set(window.free)
    assert asked(world, told) == {(k, p) for k in point.keyframes - told}
    point.keyframes -= told - {11}
    assert asked(world, told) == {(11, p)}
    point.keyframes &= {11, AWAY}
    assert asked(world, told) == set(), "twice in all: it says nothing of sizes"


@pytest.mark.parametrize("count", [FEW, FEW + 1])
def test_more_than_a_few_points_that_agree_have_the_say(count):
    world, window = turned_away(1.0)
    window, points = tied_by(world, window, count, 0.4)
    assert {p for _, p in asked(world, set(window.free))} == (set(points) if count <= FEW else set())


@pytest.mark.parametrize(("right", "left_out"), [(1, True), (2, False), (3, False)])
def test_so_have_the_right_ones_where_most_are(right, left_out):
    world, window = turned_away(1.0)
    window, points = tied_by(world, window, 2 + right, 0.4)
    for p in points[2:]:
        world.points[p].position = world.points[p].position / 0.4
    found = {p for _, p in asked(world, set(window.free))}
    assert found == (set(points[:2]) if left_out else set())


def test_only_what_a_network_can_tell_counts_against_a_point():
    world, window = turned_away(1.0)
    window, (p,) = tied_by(world, window, 1, 0.4)
    told = set(window.free)
    assert asked(world, told, log_units=np.log(0.4)) == set(), "as the network has it"
    off = -np.log(0.4)
    assert asked(world, told, sigma=0.9 * SHARE * off / 3.0)
    assert asked(world, told, sigma=1.25 * SHARE * off / 3.0) == set(), "of an image as odd as that"
    assert astray(world, told, [], sorted(world.points), 0.0) == set()
    place = world.points[p].position
    world.points[p].position = -place  # behind all of them
    assert asked(world, told) == set()
    world.points[p].position = place
    assert asked(world, told)
    for k in told:
        world.keyframes[k].depths[world.keyframes[k].observed[p]] = 0.0
    assert asked(world, told) == set()


def test_what_says_how_far_each_point_is_has_no_vote_on_sizes(monkeypatch):
    """It would count twice."""
    world, window = turned_away(1.0)
    heard = []
    monkeypatch.setattr(module, "sizes", lambda world, keyframes, *_: heard.append(keyframes) or [])
    for sigma in (0.0, 0.01):
        for keyframe in world.keyframes.values():
            keyframe.depth_sigma = sigma
        module.assemble(world, window, CONFIG, 1.0, use_depth=True, use_rays=True)
    assert heard == [window.free, []]
    # Nor has a network whose every depth is a factor, which it is while one pose is held.
    young = Window(window.held[1:] + window.free, [0], window.points)
    module.assemble(world, young, CONFIG, 1.0, use_depth=True, use_rays=True)
    assert heard[2:] == [[]]


def test_a_network_says_nothing_of_the_size_of_what_held_poses_place():
    world, _ = grown(1.0, depth_factor=1.5)
    for keyframe in world.keyframes.values():
        keyframe.depth_units = 1.0
    points = sorted(p for p, point in world.points.items() if len(point.keyframes) >= 2)
    window = Window([3, 4, 5], [0, 1, 2], points)
    assert untied(world, window.held, window.free, window.points) == []
    alone, told = (solve(world, window, CONFIG, 1.0, use_depth) for use_depth in (False, True))
    for k in window.free:
        np.testing.assert_allclose(told.poses[k], alone.poses[k], atol=1e-6)
