"""Relative poses from matches alone, against the motion that made them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from prism_edge.geometry.cameras import Camera
from prism_edge.geometry.poses import inverse, rotation_angle, se3_exp, transform
from prism_edge.tracking.two_view_pose import lead_apart, refine_two_view_pose, sampson_distances

CAMERA = Camera(640, 480, 525.0, 525.0, 320.0, 240.0)


def matches(first_from_second, noise_px=0.0, count=200, seed=0):
    rng = np.random.default_rng(seed)
    points = rng.uniform((-2, -1.5, 3), (2, 1.5, 8), (count, 3))
    a, b = CAMERA.project(points), CAMERA.project(transform(inverse(first_from_second), points))
    return a + rng.normal(0, noise_px, a.shape), b + rng.normal(0, noise_px, b.shape)


def angle_between(a, b):
    return np.degrees(np.arccos(np.clip(a @ b / np.linalg.norm(a) / np.linalg.norm(b), -1, 1)))


@settings(max_examples=25, deadline=None)
@given(
    st.tuples(*[st.floats(-0.3, 0.3)] * 3).filter(lambda t: np.linalg.norm(t) > 0.1),
    st.tuples(*[st.floats(-0.1, 0.1)] * 3),
)
@example((0.00390625, 0.0, -0.109375), (0.0, 0.0, 0.0))  # straight ahead, the start 17 degrees off
def test_exact_matches_give_back_the_motion_and_keep_the_length(translation, rotation):
    truth = se3_exp(np.array([*translation, *rotation]))
    a, b = matches(truth)
    start = truth @ se3_exp(np.array([0.02, -0.02, 0.01, 0.01, -0.01, 0.01]))
    found, cost = refine_two_view_pose(CAMERA, a, b, start)
    assert cost < 1e-6
    assert rotation_angle(found[:3, :3].T @ truth[:3, :3]) < 1e-4
    assert angle_between(found[:3, 3], truth[:3, 3]) < 0.05
    assert np.linalg.norm(found[:3, 3]) == pytest.approx(np.linalg.norm(start[:3, 3]))


def test_distances_are_those_of_a_point_moved_across_its_epipolar_line():
    truth = se3_exp(np.array([0.4, 0.0, 0.0, 0.0, 0.0, 0.0]))  # sideways: epipolar lines are rows
    a, b = matches(truth)
    b[:, 1] += 0.8
    # Half of the offset is put on each side: 0.8 / sqrt(2).
    assert np.abs(sampson_distances(CAMERA, a, b, truth)) == pytest.approx(0.8 / np.sqrt(2), rel=1e-6)


def test_a_fifth_of_wrong_matches_hardly_moves_the_result():
    truth = se3_exp(np.array([0.3, 0.1, 0.1, 0.02, -0.03, 0.01]))
    a, b = matches(truth, noise_px=0.3)
    b[::5] += np.random.default_rng(1).uniform(-40, 40, b[::5].shape)
    found, _ = refine_two_view_pose(CAMERA, a, b, truth @ se3_exp(np.full(6, 0.01)))
    assert np.degrees(rotation_angle(found[:3, :3].T @ truth[:3, :3])) < 0.3
    assert angle_between(found[:3, 3], truth[:3, 3]) < 3.0


def test_no_translation_to_begin_with_is_left_alone():
    a, b = matches(np.eye(4))
    found, cost = refine_two_view_pose(CAMERA, a, b, np.eye(4))
    assert np.array_equal(found, np.eye(4))
    assert cost == np.inf


def test_matches_of_a_single_point_tell_nothing_and_break_nothing():
    same = np.tile([[320.0, 240.0]], (30, 1))
    start = se3_exp(np.array([0.1, 0, 0, 0, 0, 0]))
    found, cost = refine_two_view_pose(CAMERA, same, same + 1.0, start)
    assert np.array_equal(found, start)
    assert cost == np.inf


def test_where_focal_lengths_differ_their_geometric_mean_makes_pixels():
    camera = Camera(640, 480, 600.0, 400.0, 320.0, 240.0)
    truth = se3_exp(np.array([0.4, 0.0, 0.0, 0.0, 0.0, 0.0]))
    points = np.random.default_rng(0).uniform((-2, -1.5, 3), (2, 1.5, 8), (50, 3))
    a, b = camera.project(points), camera.project(transform(inverse(truth), points))
    b[:, 1] += 0.8
    expected = 0.8 / 400.0 / np.sqrt(2) * np.sqrt(600.0 * 400.0)
    assert np.abs(sampson_distances(camera, a, b, truth)) == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize(("between_deg", "apart"), [(0.0, False), (29.0, False), (31.0, True), (180.0, True)])
def test_two_motions_lead_apart_by_their_directions_alone(between_deg, apart):
    between = np.radians(between_deg)
    one = se3_exp(np.array([0.0, 0.0, 0.0, 0.3, 0.2, 0.1]))
    other = np.eye(4)
    one[:3, 3], other[:3, 3] = (2.0, 0.0, 0.0), (0.1 * np.cos(between), 0.0, 0.1 * np.sin(between))
    assert lead_apart(one, other, np.radians(30.0)) == apart


def test_who_stands_still_leads_nowhere():
    assert not lead_apart(np.eye(4), se3_exp(np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0])), 0.5)
