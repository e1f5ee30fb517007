"""What a map explains as it stands, on clouds seen by cameras whose true poses are known."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from prism_edge.backend.free_points import _Reduced, _views, explained, placed
from prism_edge.backend.global_map import GlobalMap, GlobalPoint
from prism_edge.backend.loops import Loop, with_free_points
from prism_edge.geometry.poses import inverse, rotation_angle, se3_exp, se3_log, transform
from tests.backend.returning import NOISE_PX, QUERY, off_along_rays, pose_by_points, seen_again
from tests.backend.world import Teller
from tests.tracking.cloud import pose_at


def test_a_right_map_explains_all():
    assert explained(*seen_again()) > 0.98


def test_residuals_are_the_projection_s_and_slopes_those_of_a_point_that_moves_a_little():
    """In views that are turned against each other, of corners on all levels of the pyramid."""
    teller, world = Teller(120, noise_px=NOISE_PX), GlobalMap()
    for i in range(4):
        world.absorb(teller.keyframe(pose_at(0.1 * i, 0.05 * i, 0.0, 0.05 * i, -0.1 * i, 0.2 * i)))
    query = world.keyframes[3]
    pairs = [(i, p) for p, i in query.observed.items() if len(world.points[p].keyframes) > 1]
    views = _views(world, query, pairs)
    places = np.array([world.points[p].position for _, p in pairs])
    residual, slopes, seen = views.linearise(places)
    assert seen.all()
    assert len(residual) == sum(len(world.points[p].keyframes) for _, p in pairs)
    keyframes = [k for _, p in pairs for k in sorted(world.points[p].keyframes)]  # the query is the last
    points = [p for _, p in pairs for _ in world.points[p].keyframes]
    for row, (k, p) in enumerate(zip(keyframes, points, strict=True)):
        keyframe, keypoint = world.keyframes[k], world.keyframes[k].observed[p]
        local = transform(inverse(keyframe.world_from_camera), world.points[p].position[None])
        off = keyframe.camera.project(local)[0] - keyframe.pixels[keypoint]
        assert residual[row] == pytest.approx(off / keyframe.sigmas[keypoint], abs=1e-6)
    for axis, step in enumerate(1e-5 * np.eye(3)):
        ahead, behind = views.linearise(places + step)[0], views.linearise(places - step)[0]
        assert slopes[:, :, axis] == pytest.approx((ahead - behind) / 2e-5, rel=1e-4, abs=1e-3)


def test_points_of_little_parallax_may_be_off_in_depth_though_a_pose_by_them_then_is_too():
    world, query, pairs = seen_again()
    off_along_rays(world, pairs, 0.4)
    by_points = pose_by_points(world, query, pairs)
    assert rotation_angle(QUERY[:3, :3].T @ by_points[:3, :3]) > np.radians(1.0)
    assert explained(world, query, pairs) > 0.95


@pytest.mark.parametrize(
    "twist", [[0, 0, 0, 0, 0.04, 0], [0, 0, 0, 0.04, 0, 0], [0, 0, 0, 0, 0, 0.12], [0, 0.2, 0, 0, 0, 0]]
)
def test_what_has_drifted_is_not_explained_by_any_depth(twist):
    world, query, pairs = seen_again()
    query.world_from_camera = query.world_from_camera @ se3_exp(np.array(twist, float))
    assert explained(world, query, pairs) < 0.5


def test_a_point_is_one_pair_however_many_see_it():
    world, query, pairs = seen_again()
    wrong = pairs[: len(pairs) // 4]
    for i, _ in wrong:
        query.pixels[i, 1] += 40.0
    assert explained(world, query, pairs) == pytest.approx(1.0 - len(wrong) / len(pairs), abs=0.03)


def test_nothing_is_explained_by_a_query_that_looks_away_nor_where_there_are_no_pairs():
    world, query, pairs = seen_again()
    query.world_from_camera = query.world_from_camera @ se3_exp(np.array([0, 0, 0, 0, np.pi, 0]))
    assert explained(world, query, pairs) < 0.1
    assert explained(world, query, []) == 0.0


def test_the_map_is_left_as_it_is():
    world, query, pairs = seen_again()
    before = {p: point.position.copy() for p, point in world.points.items()}
    explained(world, query, pairs)
    assert all(np.array_equal(world.points[p].position, before[p]) for p in before)


@given(shift=st.lists(st.floats(-30.0, 30.0), min_size=6, max_size=6))
@settings(max_examples=40, deadline=None)
def test_no_pose_makes_more_than_a_share_of_it(shift):
    world, query, pairs = seen_again()
    query.world_from_camera = se3_exp(np.array(shift)) @ query.world_from_camera
    with np.errstate(all="raise", under="ignore"):
        assert 0.0 <= explained(world, query, pairs) <= 1.0


def test_a_query_is_placed_though_its_points_are_off_in_depth():
    """Where the points as the map has them lead astray; what is still in doubt is said."""
    world, query, pairs = seen_again()
    off_along_rays(world, pairs, 0.4)
    by_points = pose_by_points(world, query, pairs)
    found = placed(world, query, pairs, [by_points])
    off, before = (se3_log(inverse(pose) @ QUERY) for pose in (found.world_from_query, by_points))
    assert np.linalg.norm(before[3:]) > np.radians(1.0) > 3.0 * np.linalg.norm(off[3:])
    assert off @ found.information @ off < 16.8  # 99 of 100, six degrees of freedom
    assert np.sqrt(np.diag(np.linalg.inv(found.information))[:3]).max() < 0.05


def test_a_few_gross_mismatches_do_not_take_a_query_along():
    world, query, pairs = seen_again()
    query.pixels = query.pixels.copy()
    query.pixels[[i for i, _ in pairs[:4]]] += (80.0, -50.0)
    off = se3_log(inverse(placed(world, query, pairs, [QUERY]).world_from_query) @ QUERY)
    assert np.linalg.norm(off[:3]) < 0.05
    assert np.linalg.norm(off[3:]) < np.radians(0.5)


def test_a_step_is_that_of_pose_and_points_together():
    """Eliminated or not, it is the same system that is solved."""
    world, query, pairs = seen_again()
    off_along_rays(world, pairs, 0.4)
    places = np.array([world.points[p].position for _, p in pairs])
    at = _Reduced.at(_views(world, query, pairs), QUERY @ pose_at(0.02, 0.01), places)
    n = 3 * len(pairs)
    whole = np.zeros((6 + n, 6 + n))
    whole[:6, :6] = at.of_pose
    whole[:6, 6:] = at.between.transpose(1, 0, 2).reshape(6, n)
    whole[6:, :6] = whole[:6, 6:].T
    for i, block in enumerate(at.of_points):
        whole[6 + 3 * i : 9 + 3 * i, 6 + 3 * i : 9 + 3 * i] = block
    step = -np.linalg.solve(whole, np.r_[at.by_pose, at.by_points.ravel()])
    twist, shifts = at.step(1e-12)
    assert twist == pytest.approx(step[:6], rel=1e-3, abs=1e-6)
    assert shifts.ravel() == pytest.approx(step[6:], rel=1e-3, abs=1e-5)


def test_what_a_placed_query_says_is_the_curvature_of_its_cost_with_points_that_follow():
    world, query, pairs = seen_again()
    found = placed(world, query, pairs, [query.world_from_camera])

    def cost_at(twist):
        views = _views(world, query, pairs)
        pose, places = found.world_from_query @ se3_exp(twist), found.places
        for _ in range(4):
            at = _Reduced.at(views, pose, places)
            places = places - np.linalg.solve(at.of_points, at.by_points[:, :, None])[:, :, 0]
        return _Reduced.at(views, pose, places).cost

    for axis in np.eye(6):
        step = 0.3 / np.sqrt(axis @ found.information @ axis)
        rise = cost_at(step * axis) + cost_at(-step * axis) - 2.0 * cost_at(np.zeros(6))
        assert rise == pytest.approx(2.0 * 0.3**2, rel=0.2)


@pytest.mark.parametrize("views", [1, 2, 3])
def test_the_ratio_of_units_is_as_sure_as_the_depths_that_its_points_share(views):
    """Where nothing but a short way says how far all of them are, however many they are."""
    off = []
    for seed in range(12):
        world, query, pairs = seen_again(seed, views)
        pairs, rng, centre = pairs[:60], np.random.default_rng(100 + seed), QUERY[:3, 3]
        for n, (keypoint, point) in enumerate(pairs):  # the query's own, in the same unit
            there = centre + (world.points[point].position - centre) * np.exp(rng.normal(0.0, 0.02))
            world.points[100000 + n] = GlobalPoint(there)
            query.observed[100000 + n] = keypoint
        query.world_from_camera = QUERY
        found = with_free_points(world, Loop(query.id, 0, QUERY, 1.0, 0.01, len(pairs), 3, pairs))
        off.append(np.log(found.scale) / found.log_scale_sigma)
    assert np.sqrt(np.mean(np.square(off))) < 2.0


def test_what_the_depths_of_a_placed_query_share_is_how_they_follow_it():
    world, query, pairs = seen_again()
    found = placed(world, query, pairs, [QUERY])
    views = _views(world, query, pairs)

    def mean_log_depth(twist):
        pose, places = found.world_from_query @ se3_exp(twist), found.places
        for _ in range(4):
            at = _Reduced.at(views, pose, places)
            places = places - np.linalg.solve(at.of_points, at.by_points[:, :, None])[:, :, 0]
        return np.log(transform(inverse(pose), places)[:, 2]).mean()

    for axis, slope in zip(np.eye(6), found.deepening, strict=True):
        numerical = (mean_log_depth(1e-5 * axis) - mean_log_depth(-1e-5 * axis)) / 2e-5
        assert numerical == pytest.approx(slope, rel=0.05, abs=0.05)


def test_of_two_starts_that_counts_which_comes_out_better():
    world, query, pairs = seen_again()
    away = QUERY @ se3_exp(np.array([0, 0, 0, 0, np.pi, 0]))
    found = placed(world, query, pairs, [away, QUERY])
    assert rotation_angle(QUERY[:3, :3].T @ found.world_from_query[:3, :3]) < np.radians(0.5)
    assert placed(world, query, pairs[:5], [QUERY]) is None
