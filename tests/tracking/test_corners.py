"""Corners against edges: drawn shapes whose places are known, and OpenCV's own Harris measure."""

from __future__ import annotations

import cv2
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from prism_edge.tracking.corners import REACH, SIDE, are_corners
from tests.synthetic.scene import block_texture


def noisy(image: np.ndarray, seed: int = 0) -> np.ndarray:
    grain = np.random.default_rng(seed).normal(0.0, 2.0, image.shape)
    return np.clip(np.round(cv2.GaussianBlur(image, (0, 0), 0.7) + grain), 0, 255).astype(np.uint8)


def patch(image: np.ndarray, x: int, y: int) -> np.ndarray:
    return image[y - REACH : y + REACH + 1, x - REACH : x + REACH + 1]


def judged(image: np.ndarray) -> bool:
    """Of its middle."""
    return bool(are_corners(patch(image, image.shape[1] // 2, image.shape[0] // 2)[None])[0])


@settings(max_examples=100, deadline=None)
@given(st.floats(0.0, 180.0), st.integers(0, 100))
def test_a_step_is_an_edge_whichever_way_it_runs(degrees, seed):
    y, x = np.mgrid[:61, :81].astype(float)
    across = np.array([np.cos(np.radians(degrees)), np.sin(np.radians(degrees))])
    bright = (x - 40.0) * across[0] + (y - 30.0) * across[1] > 0.0
    assert not judged(noisy(np.where(bright, 200.0, 60.0), seed))


@settings(max_examples=100, deadline=None)
@given(st.floats(0.0, 360.0), st.integers(0, 100))
def test_where_two_edges_meet_is_a_corner(degrees, seed):
    y, x = np.mgrid[:61, :81].astype(float)
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    along, across = (x - 40.0) * c + (y - 30.0) * s, -(x - 40.0) * s + (y - 30.0) * c
    image = np.where((along > 0.0) & (across > 0.0), 200.0, 60.0)
    assert judged(noisy(image, seed))


def test_it_says_what_opencv_s_harris_measure_says():
    drawn = np.full((480, 640), 205.0)
    for k in range(8):  # joints of a wall, and a picture that hangs on it
        cv2.line(drawn, (-20, 60 * k), (660, 60 * k + 70), 60.0, 3, cv2.LINE_AA)
        cv2.line(drawn, (90 * k, -20), (90 * k - 40, 500), 60.0, 3, cv2.LINE_AA)
    drawn[100:260, 100:300] = block_texture(np.random.default_rng(2), 200, 160)
    image = noisy(drawn)
    orb = cv2.ORB.create(30000, nlevels=1, edgeThreshold=19, scoreType=cv2.ORB_HARRIS_SCORE, fastThreshold=5)
    keypoints = orb.detect(image)
    harris = np.array([k.response > 0.0 for k in keypoints])
    ours = are_corners(np.array([patch(image, *map(int, k.pt)) for k in keypoints]))
    assert 0.2 < harris.mean() < 0.8
    assert np.mean(ours == harris) > 0.95


def worn_edges() -> np.ndarray:
    """Patches of upright edges, from clean ones to such that hardly are any."""
    rng = np.random.default_rng(1)
    edge = 60.0 + 100.0 * (np.arange(SIDE) > SIDE // 2) * np.ones((500, SIDE, 1))
    patches = np.round(edge + rng.normal(0.0, rng.uniform(0.0, 40.0, (500, 1, 1)), edge.shape))
    return np.clip(patches, 0, 255).astype(np.uint8)


def test_it_is_harris_measure_of_sobels_gradients_at_25_places():
    at = REACH + np.array([-3, -2, 0, 2, 3])
    measures = []
    for patch in worn_edges():
        gx, gy = (cv2.Sobel(patch, cv2.CV_64F, *axes)[np.ix_(at, at)].ravel() for axes in ((1, 0), (0, 1)))
        tensor = np.array([[gx @ gx, gx @ gy], [gx @ gy, gy @ gy]])
        measures.append(np.linalg.det(tensor) / np.trace(tensor) ** 2)
    is_clear = np.abs(np.array(measures) - 0.04) > 1e-6
    assert np.sum(is_clear) > 490
    assert np.array_equal(are_corners(worn_edges())[is_clear], np.array(measures)[is_clear] > 0.04)


def test_turned_upside_down_and_mirrored_it_stays_what_it_was():
    patches = worn_edges()
    answers = are_corners(patches)
    assert 0.1 < answers.mean() < 0.9
    for other in (patches[:, ::-1], patches[:, :, ::-1], patches.transpose(0, 2, 1)):
        assert np.array_equal(are_corners(other), answers)


def test_no_keypoints_no_answer():
    assert are_corners(np.zeros((0, SIDE, SIDE), np.uint8)).shape == (0,)
