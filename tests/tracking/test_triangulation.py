"""Triangulation and epipolar matching on exact scenes, and against OpenCV."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from prism_edge.geometry.field_of_view import in_image
from prism_edge.geometry.poses import inverse, se3_exp, transform
from prism_edge.tracking.features import Features
from prism_edge.tracking.triangulation import match_epipolar, rays, triangulate
from tests.tracking.cloud import CAMERA, FACTORS, Cloud, pose_at

twists = st.lists(st.floats(-0.3, 0.3), min_size=6, max_size=6)


def seen(pose: np.ndarray, points: np.ndarray) -> np.ndarray:
    return CAMERA.project(transform(inverse(pose), points))


@settings(max_examples=50, deadline=None)
@given(first=twists, second=twists, seed=st.integers(0, 1000))
def test_exact_rays_meet_in_their_point(first, second, seed):
    a, b = se3_exp(np.array(first)), se3_exp(np.array(second)) @ pose_at(0.4)
    points = np.random.default_rng(seed).uniform((-1, -1, 3), (1, 1, 6), (20, 3))
    ray_a, ray_b = rays(CAMERA, seen(a, points)), rays(CAMERA, seen(b, points))
    found, depth_a, depth_b, parallax = triangulate(a, b, ray_a, ray_b)
    to_a, to_b = points - a[:3, 3], points - b[:3, 3]
    cosine = (to_a * to_b).sum(1) / np.linalg.norm(to_a, axis=1) / np.linalg.norm(to_b, axis=1)
    wide = cosine < np.cos(0.01)
    assert np.abs(found - points)[wide].max(initial=0.0) < 1e-6
    assert depth_a[wide] == pytest.approx(transform(inverse(a), points)[wide, 2], rel=1e-6)
    assert depth_b[wide] == pytest.approx(transform(inverse(b), points)[wide, 2], rel=1e-6)
    assert parallax == pytest.approx(np.arccos(np.clip(cosine, -1, 1)), abs=1e-6)


def test_noisy_rays_agree_with_opencv():
    rng = np.random.default_rng(0)
    a, b = pose_at(0.0, 0.0, 0.0, 0.0, 0.05), pose_at(0.8, 0.1, 0.0, 0.02, -0.1)
    points = rng.uniform((-1, -1, 3), (1, 1, 6), (50, 3))
    pixels_a = seen(a, points) + rng.normal(0, 0.5, (50, 2))
    pixels_b = seen(b, points) + rng.normal(0, 0.5, (50, 2))
    found = triangulate(a, b, rays(CAMERA, pixels_a), rays(CAMERA, pixels_b))[0]
    projections = [CAMERA.matrix @ inverse(pose)[:3] for pose in (a, b)]
    homogeneous = cv2.triangulatePoints(*projections, pixels_a.T.copy(), pixels_b.T.copy())
    reference = (homogeneous[:3] / homogeneous[3]).T
    # Both differ from the truth by the noise; from each other by much less.
    between = np.linalg.norm(found - reference, axis=1)
    assert np.median(between) < 0.2 * np.median(np.linalg.norm(reference - points, axis=1))


def test_a_midpoint_is_half_way_between_skew_rays():
    a, b = np.eye(4), pose_at(1.0)
    ray_a, ray_b = np.array([[0.0, 0.1, 1.0]]), np.array([[-0.5, -0.1, 1.0]])
    point, za, zb, _ = triangulate(a, b, ray_a, ray_b)
    on_a, on_b = ray_a[0] * za[0], np.array([1.0, 0, 0]) + ray_b[0] * zb[0]
    assert point[0] == pytest.approx((on_a + on_b) / 2)
    gap = on_b - on_a
    assert gap @ ray_a[0] == pytest.approx(0.0, abs=1e-12)
    assert gap @ ray_b[0] == pytest.approx(0.0, abs=1e-12)


def test_parallel_rays_meet_nowhere():
    ray = np.array([[0.1, -0.2, 1.0]])
    for b in (pose_at(1.0), np.eye(4)):
        point, depth_a, depth_b, parallax = triangulate(np.eye(4), b, ray, ray)
        assert np.isinf(depth_a[0])
        assert np.isinf(depth_b[0])
        assert np.isfinite(point).all()
        assert parallax[0] < 1e-6


def test_rays_that_face_each_other_on_one_line_meet_nowhere():
    facing = np.diag([-1.0, 1.0, -1.0, 1.0])
    facing[2, 3] = 8.0
    ray = np.array([[0.0, 0.0, 1.0]])
    point, depth_a, depth_b, parallax = triangulate(np.eye(4), facing, ray, ray)
    assert np.isinf(depth_a[0])
    assert np.isinf(depth_b[0])
    assert np.isfinite(point).all()
    assert parallax[0] == pytest.approx(np.pi)


def test_diverging_rays_meet_behind():
    _, depth_a, depth_b, _ = triangulate(
        np.eye(4), pose_at(1.0), np.array([[-0.1, 0, 1.0]]), np.array([[0.1, 0, 1.0]])
    )
    assert depth_a[0] < 0
    assert depth_b[0] < 0


@pytest.fixture
def two_views():
    cloud = Cloud(400, seed=1)
    a, b = pose_at(0.0, 0.0, 0.0, 0.0, 0.05), pose_at(0.5, 0.05, 0.1, 0.0, -0.05, 0.6)
    (features_a, shown_a), (features_b, shown_b) = (cloud.view(pose, 0.3, bits=15) for pose in (a, b))
    return a, b, features_a, shown_a, features_b, shown_b


def match(a, b, features_a, features_b, free_a=None, free_b=None, depths=(1.5, 8.0)):
    return match_epipolar(
        CAMERA,
        CAMERA,
        inverse(a) @ b,
        features_a,
        features_b,
        np.arange(len(features_a)) if free_a is None else free_a,
        np.arange(len(features_b)) if free_b is None else free_b,
        FACTORS,
        depths,
    )


def test_epipolar_matches_are_the_right_ones(two_views):
    a, b, features_a, shown_a, features_b, shown_b = two_views
    i, j = match(a, b, features_a, features_b)
    common = len(np.intersect1d(shown_a, shown_b))
    assert len(i) > 0.85 * common
    assert np.array_equal(shown_a[i], shown_b[j])
    assert len(np.unique(i)) == len(np.unique(j)) == len(i)


def test_claimed_keypoints_are_left_alone(two_views):
    a, b, features_a, shown_a, features_b, shown_b = two_views
    free_a, free_b = np.arange(0, len(features_a), 2), np.arange(1, len(features_b), 3)
    i, j = match(a, b, features_a, features_b, free_a, free_b)
    assert len(i) > 10
    assert np.isin(i, free_a).all()
    assert np.isin(j, free_b).all()
    assert np.array_equal(shown_a[i], shown_b[j])
    none = np.zeros(0, np.intp)
    for free in ((none, free_b), (free_a, none)):
        assert len(match(a, b, features_a, features_b, *free)[0]) == 0


def test_wrong_geometry_matches_next_to_nothing(two_views):
    a, b, features_a, _, features_b, _ = two_views
    right = len(match(a, b, features_a, features_b)[0])
    tilted = b @ pose_at(0, 0, 0, 0.2, 0, 0)
    assert len(match(a, tilted, features_a, features_b)[0]) < 0.1 * right


def test_other_descriptors_match_nothing(two_views):
    a, b, features_a, _, features_b, _ = two_views
    rng = np.random.default_rng(9)
    words = rng.integers(0, 2**64, features_b.descriptors.shape, dtype=np.uint64)
    other = Features.build(features_b.pixels, features_b.octaves, words, CAMERA.width, CAMERA.height)
    assert len(match(a, b, features_a, other)[0]) == 0


def test_matches_lie_within_the_depth_range(two_views):
    a, b, features_a, shown_a, features_b, _ = two_views
    i, _ = match(a, b, features_a, features_b, depths=(1.5, 2.6))
    depth = Cloud(400, seed=1).positions[shown_a[i]] - a[:3, 3]
    # The search reaches 10 pixels beyond the segment's ends: 0.5 m of baseline makes that a metre here.
    assert len(i) > 10
    assert (depth @ a[:3, 2]).max() < 3.2


@pytest.mark.parametrize("way", [(0.4, 0.0), (-0.4, 0.0), (0.0, 0.4), (0.0, -0.4)])
@pytest.mark.parametrize(("depths", "matches"), [((2, 5), True), ((5, 8), False), ((1, 2), False)])
def test_a_match_lies_between_both_ends_whichever_way_the_camera_moved(way, depths, matches):
    """Of what is 3 m away; beyond either end by more than the ten pixels that are allowed."""
    b = pose_at(*way)
    points = np.random.default_rng(4).uniform((-1.0, -1.0, 3.0), (1.0, 1.0, 3.0), (10, 3))
    words = Cloud(10, seed=2).descriptors
    features_a, features_b = (
        Features.build(seen(pose, points), np.zeros(10, np.intp), words, CAMERA.width, CAMERA.height)
        for pose in (np.eye(4), b)
    )
    for i in range(10):
        one = np.array([i])
        assert len(match(np.eye(4), b, features_a, features_b, one, one, depths)[0]) == matches


@pytest.mark.parametrize(
    ("levels", "sigmas", "matches"),
    [
        ((3, 3), 0.95 * 1.96, True),
        ((3, 3), 1.05 * 1.96, False),
        ((4, 3), 0.0, True),
        ((2, 3), 0.0, True),
        ((5, 3), 0.0, False),
        ((1, 3), 0.0, False),
    ],
)
def test_a_match_is_on_a_like_level_and_as_far_from_its_line_as_that_allows(levels, sigmas, matches):
    """A pixel of the third level is as large as 1.7 of the image's."""
    b, points = pose_at(0.4), Cloud(200, seed=2).positions
    words = Cloud(200, seed=2).descriptors
    features_a, features_b = (
        Features.build(pixels, np.full(200, level, np.intp), words, CAMERA.width, CAMERA.height)
        for pixels, level in (
            (seen(np.eye(4), points), levels[0]),
            (seen(b, points) + np.array([0.0, sigmas * FACTORS[3]]), levels[1]),
        )
    )
    for i in range(0, 200, 10):
        one = np.array([i])
        assert len(match(np.eye(4), b, features_a, features_b, one, one)[0]) == matches


@pytest.mark.parametrize(("sigmas", "matches"), [(0.95 * 1.96, True), (1.05 * 1.96, False)])
def test_a_match_is_as_far_from_a_slanted_epipolar_line_as_pixels_say(sigmas, matches):
    """Moved at right angles to the line, which focal lengths that differ turn in the image."""
    b = pose_at(0.4, 0.2)
    points = Cloud(200, seed=2).positions
    first, second = seen(np.eye(4), points), seen(b, points)
    along = np.array([0.4 * CAMERA.fx, 0.2 * CAMERA.fy])
    second = second + sigmas * np.array([-along[1], along[0]]) / np.linalg.norm(along)
    words = Cloud(200, seed=2).descriptors
    features_a, features_b = (
        Features.build(pixels, np.zeros(200, np.intp), words, CAMERA.width, CAMERA.height)
        for pixels in (first, second)
    )
    for i in range(0, 200, 10):  # each by itself: no other may be on its line
        one = np.array([i])
        assert len(match(np.eye(4), b, features_a, features_b, one, one)[0]) == matches


@pytest.mark.parametrize("turn", [0.0, 0.3])
@pytest.mark.parametrize("ahead", [-6.0, -1.0, 1.0, 3.0, 4.0, 6.0])
def test_a_camera_beyond_what_was_near_still_matches_all_that_it_sees(ahead, turn):
    """One that backs up, or a recording played backwards: part of each ray's depths lies behind it."""
    rng = np.random.default_rng(0)
    points = rng.uniform((-8.0, -3.0, 5.0), (8.0, 3.0, 30.0), (300, 3))
    a_from_b = se3_exp(np.array([0.1, 0.0, ahead, 0.0, turn, 0.0]))
    there = transform(inverse(a_from_b), points)
    ahead_of_both = there[:, 2] > 0.3
    points, there = points[ahead_of_both], there[ahead_of_both]
    shown = in_image(CAMERA, CAMERA.project(points)) & in_image(CAMERA, CAMERA.project(there))
    points, there = points[shown], there[shown]
    descriptors = rng.integers(0, 2**63, (len(points), 4), dtype=np.uint64)
    octaves, size = np.zeros(len(points), np.intp), (CAMERA.width, CAMERA.height)
    first, second = (Features.build(CAMERA.project(p), octaves, descriptors, *size) for p in (points, there))
    free, depths = np.arange(len(points)), (0.4 * points[:, 2].min(), 2.0 * points[:, 2].max())
    a, b = match_epipolar(CAMERA, CAMERA, a_from_b, first, second, free, free, FACTORS, depths)
    assert len(points) > 60
    assert np.array_equal(a, b)
    assert len(a) == len(points)
