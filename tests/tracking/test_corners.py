"""Corners against edges: drawn shapes whose places are known, and OpenCV's own Harris measure."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from prism_edge.tracking.corners import MARGIN, are_corners
from tests.synthetic.scene import block_texture

FACTORS = 1.2 ** np.arange(8)


def noisy(image: np.ndarray, seed: int = 0) -> np.ndarray:
    grain = np.random.default_rng(seed).normal(0.0, 2.0, image.shape)
    return np.clip(np.round(cv2.GaussianBlur(image, (0, 0), 0.7) + grain), 0, 255).astype(np.uint8)


def judged(image: np.ndarray, pixel: np.ndarray, octave: int = 0) -> bool:
    pixels = np.asarray(pixel, np.float32).reshape(1, 2)
    return bool(are_corners(image, pixels, np.array([octave], np.intp), FACTORS)[0])


@settings(max_examples=40, deadline=None)
@given(st.floats(0.0, 180.0), st.integers(0, 4), st.integers(0, 100))
def test_a_step_is_an_edge_whichever_way_it_runs(degrees, octave, seed):
    y, x = np.mgrid[:161, :201].astype(float)
    across = np.array([np.cos(np.radians(degrees)), np.sin(np.radians(degrees))])
    bright = (x - 100.0) * across[0] + (y - 80.0) * across[1] > 0.0
    assert not judged(noisy(np.where(bright, 200.0, 60.0), seed), (100.0, 80.0), octave)


@settings(max_examples=40, deadline=None)
@given(st.floats(0.0, 90.0), st.integers(0, 4), st.integers(0, 100))
def test_where_two_edges_meet_is_a_corner(degrees, octave, seed):
    y, x = np.mgrid[:161, :201].astype(float)
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    along, across = (x - 100.0) * c + (y - 80.0) * s, -(x - 100.0) * s + (y - 80.0) * c
    image = np.where((along > 0.0) & (across > 0.0), 200.0, 60.0)
    assert judged(noisy(image, seed), (100.0, 80.0), octave)


def test_it_says_what_opencv_s_harris_measure_says():
    drawn = np.full((480, 640), 205.0)
    for k in range(8):  # joints of a wall, and a picture that hangs on it
        cv2.line(drawn, (-20, 60 * k), (660, 60 * k + 70), 60.0, 3, cv2.LINE_AA)
        cv2.line(drawn, (90 * k, -20), (90 * k - 40, 500), 60.0, 3, cv2.LINE_AA)
    drawn[100:260, 100:300] = block_texture(np.random.default_rng(2), 200, 160)
    image = noisy(drawn)
    orb = cv2.ORB.create(nfeatures=30000, edgeThreshold=19, scoreType=cv2.ORB_HARRIS_SCORE, fastThreshold=5)
    keypoints = orb.detect(image)
    harris = np.array([k.response > 0.0 for k in keypoints])
    octaves = np.array([k.octave for k in keypoints], np.intp)
    ours = are_corners(image, cv2.KeyPoint.convert(keypoints), octaves, FACTORS)
    assert 0.2 < harris.mean() < 0.8
    assert np.mean(ours == harris) > 0.9


@pytest.mark.parametrize("octave", range(8))
def test_its_window_stays_inside_the_margin(octave):
    """At the last pixel it may be asked for, nothing is read beyond the image."""
    image = noisy(block_texture(np.random.default_rng(2), 120, 100))
    border = int(np.ceil(MARGIN * FACTORS[octave]))
    for x, y in ((border, border), (119 - border, 99 - border)):
        alone = are_corners(image, np.array([[x, y]], np.float32), np.array([octave]), FACTORS)
        around = cv2.copyMakeBorder(image, 0, 50, 0, 50, cv2.BORDER_REFLECT_101)
        same = are_corners(around, np.array([[x, y]], np.float32), np.array([octave]), FACTORS)
        assert alone[0] == same[0]


def test_no_keypoints_no_answer():
    nowhere = np.zeros((0, 2), np.float32), np.zeros(0, np.intp)
    assert are_corners(np.zeros((60, 80), np.uint8), *nowhere, FACTORS).shape == (0,)
