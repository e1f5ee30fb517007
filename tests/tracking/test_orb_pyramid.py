"""ORB level by level: against OpenCV's own; the threshold; images with hardly a level."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from prism_edge.config_file import leaves
from prism_edge.tracking.orb_pyramid import BORDER, HIGHEST_THRESHOLD, MASK_MARGIN, OrbPyramid
from tests.synthetic.scene import block_texture

FACTORS = 1.3 ** np.arange(6)


def blocks(seed: int = 0) -> np.ndarray:
    return block_texture(np.random.default_rng(seed), 640, 480)


def level_images(image: np.ndarray) -> list[np.ndarray]:
    """The image halved and halved again, each pixel the mean of four."""
    images = [image]
    for _ in range(2):
        a = images[-1].astype(float)
        mean = (a[::2, ::2] + a[1::2, ::2] + a[::2, 1::2] + a[1::2, 1::2]) / 4
        images.append(np.floor(mean + 0.5).astype(np.uint8))
    return images


def test_corners_and_descriptors_are_opencvs_of_each_levels_image():
    image = blocks(1)
    pyramid = OrbPyramid(np.array([1.0, 2.0, 4.0]), 10, 100_000)
    pixels, levels, strengths = pyramid.detect(image)
    described = pyramid.describe(np.arange(len(pixels)))
    assert np.all(np.diff(levels) >= 0)
    plain = cv2.ORB.create(nfeatures=100_000, nlevels=1, edgeThreshold=BORDER, fastThreshold=10, scoreType=1)
    for level, scaled in enumerate(level_images(image)):
        keypoints, expected = plain.detectAndCompute(scaled, None)
        at = {k.pt: (k.response, d.tobytes()) for k, d in zip(keypoints, expected, strict=True)}
        mine = np.flatnonzero(levels == level)
        assert len(mine) == len(keypoints) > 50
        for i in mine:
            x, y = pixels[i] / 2.0**level
            assert at[float(x), float(y)] == (strengths[i], described[i].tobytes())


def test_only_the_chosen_are_described_each_as_among_all():
    pyramid = OrbPyramid(FACTORS, 10, 600)
    pixels, levels, _ = pyramid.detect(blocks(2))
    everything = pyramid.describe(np.arange(len(pixels)))
    few = np.flatnonzero((levels != 1) & (np.arange(len(pixels)) % 3 == 0))
    assert np.array_equal(pyramid.describe(few), everything[few])
    assert pyramid.describe(few[:0]).shape == (0, 32)


def test_every_level_has_its_share_of_the_strongest():
    image = blocks(3)
    everything, some = OrbPyramid(FACTORS, 10, 100_000), OrbPyramid(FACTORS, 10, 400)
    _, all_levels, all_strengths = everything.detect(image)
    _, levels, strengths = some.detect(image)
    counts = np.bincount(levels)
    # a level 1.3 times as large has 1.3 times as many, but for rounding and for equals at the end
    expected = 400 / FACTORS / (1 / FACTORS).sum()
    assert np.all(counts >= np.floor(expected))
    assert counts.sum() < 1.2 * 400
    for level in range(6):
        best = np.sort(all_strengths[all_levels == level])[::-1]
        mine = np.sort(strengths[levels == level])[::-1]
        assert np.array_equal(mine, best[: len(mine)])


def test_all_levels_together_are_what_opencv_finds_and_describes():
    image = blocks(6)
    plain = cv2.ORB.create(1000, 1.3, 6, edgeThreshold=BORDER, scoreType=1, fastThreshold=10)
    keypoints, expected = plain.detectAndCompute(image, None)
    theirs = {(*k.pt, k.octave, k.response, d.tobytes()) for k, d in zip(keypoints, expected, strict=True)}
    pyramid = OrbPyramid(FACTORS, 10, 1000)
    pixels, levels, strengths = pyramid.detect(image)
    described = pyramid.describe(np.arange(len(pixels)))
    columns = (pixels.tolist(), levels.tolist(), strengths.tolist(), described)
    mine = {(*at, level, response, d.tobytes()) for at, level, response, d in zip(*columns, strict=True)}
    assert len(mine) > 900
    assert mine == theirs


def test_where_texture_goes_the_faint_corners_are_found_again():
    rich, pyramid = blocks(5), OrbPyramid(FACTORS, 10, 500)
    for _ in range(9):
        pyramid.detect(rich)
    faint = (128 + (rich.astype(float) - 128) * 0.5).astype(np.uint8)
    expected = len(OrbPyramid(FACTORS, 10, 500).detect(faint)[0])
    found = [len(pyramid.detect(faint)[0]) for _ in range(10)]
    assert 0.4 * 500 < found[0] < 0.6 * expected, "not so few that the image would be searched again"
    # Two down where there is not enough, one up where there is: it stays about there.
    assert min(found[1:]) > 1.3 * found[0]
    assert max(found) > 0.9 * expected


def test_where_the_light_goes_out_the_same_image_is_searched_again():
    rich, pyramid = blocks(5), OrbPyramid(FACTORS, 10, 500)
    for _ in range(HIGHEST_THRESHOLD):
        pyramid.detect(rich)
    dim = (128 + (rich.astype(float) - 128) * 0.3).astype(np.uint8)
    expected = len(OrbPyramid(FACTORS, 10, 500).detect(dim)[0])
    stuck = OrbPyramid(FACTORS, HIGHEST_THRESHOLD, 500)
    assert len(stuck.detect(dim)[0]) < 0.4 * 500 < expected
    pixels, levels, _ = pyramid.detect(dim)
    assert len(pixels) == len(levels) == len(pyramid.describe(np.arange(len(pixels)))) == expected
    # One such image is no reason to find far too many in the next; several in a row are.
    assert HIGHEST_THRESHOLD - 2 <= pyramid._threshold < HIGHEST_THRESHOLD
    for _ in range(HIGHEST_THRESHOLD):
        assert len(pyramid.detect(dim)[0]) > 0.4 * 500
    assert pyramid._threshold < HIGHEST_THRESHOLD - 5


@pytest.mark.parametrize("size", [(480, 640), (64, 48), (24, 32), (3, 2), (1, 1)])
def test_levels_that_a_keypoint_has_no_room_in_are_left_out(size):
    image = np.random.default_rng(0).integers(0, 255, size, dtype=np.uint8)
    pyramid = OrbPyramid(2.0 ** np.arange(12), 10, 500)
    pixels, levels, strengths = pyramid.detect(image)
    assert len(pixels) == len(levels) == len(strengths)
    assert len(pyramid.describe(np.arange(len(pixels)))) == len(pixels)
    inside = (pixels > 0) & (pixels < (size[1], size[0]))
    assert inside.all()
    assert (len(pixels) > 0) == (min(size) > 2 * BORDER)


def test_corners_are_looked_for_only_where_they_may_be_and_as_many():
    image = blocks(4)
    shown = np.ones(image.shape, bool)
    shown[:, 320:] = False
    masked = OrbPyramid(FACTORS, 10, 400)
    masked.look_only_at(shown)
    pixels, levels, _ = masked.detect(image)
    assert np.all(pixels[:, 0] < 320 - (MASK_MARGIN - 1) * FACTORS[levels])
    # What is hidden takes nothing of what is wanted.
    assert len(pixels) >= 0.95 * 400
    assert len(masked.describe(np.arange(len(pixels)))) == len(pixels)


def test_where_nothing_is_hidden_a_mask_changes_nothing():
    image = blocks(5)
    masked, plain = OrbPyramid(FACTORS, 10, 400), OrbPyramid(FACTORS, 10, 400)
    masked.look_only_at(np.ones(image.shape, bool))
    for found, expected in zip(masked.detect(image), plain.detect(image), strict=True):
        assert np.array_equal(found, expected)


def dim(image: np.ndarray, noise: float, seed: int = 0) -> np.ndarray:
    """What is darker than the middle at 12 grey levels and what is brighter at 20, and a sensor's noise."""
    grain = np.random.default_rng(seed).normal(0.0, noise, image.shape)
    return np.clip(np.where(image > 128, 20.0, 12.0) + grain, 0, 255).astype(np.uint8)


def test_in_the_dark_weaker_corners_are_taken_and_are_found_again_in_the_next_image():
    image = blocks(6)
    pyramid, plain = OrbPyramid(FACTORS, 10, 1200, few=450), OrbPyramid(FACTORS, 10, 1200)
    assert len(plain.detect(dim(image, 1.0))[0]) < 450
    first, levels, _ = pyramid.detect(dim(image, 1.0, seed=1))
    second, again, _ = pyramid.detect(dim(image, 1.0, seed=2))
    assert len(first) > 1000
    near = np.linalg.norm(first[:, None] - second[None], axis=2) < 1.5 * FACTORS[levels][:, None]
    assert (near & (levels[:, None] == again[None])).any(axis=1).mean() > 0.5, "by chance, a tenth"
    assert len(pyramid.describe(np.arange(len(second)))) == len(second)


@pytest.mark.parametrize("noise", [1.0, 2.0, 3.0])
def test_noise_alone_has_no_corners_there(noise):
    grey = np.full((480, 640), 160, np.uint8)
    pixels, _, _ = OrbPyramid(FACTORS, 10, 1200, few=450).detect(dim(grey, noise))
    assert len(pixels) < 20


def test_where_there_are_enough_nothing_is_smoothed():
    image = blocks(7)
    dark, plain = OrbPyramid(FACTORS, 10, 1200, few=450), OrbPyramid(FACTORS, 10, 1200)
    for found, expected in zip(dark.detect(image), plain.detect(image), strict=True):
        assert np.array_equal(found, expected)


def test_the_lowest_threshold_can_be_no_higher_than_it_rises_to():
    (lowest,) = (leaf for leaf in leaves() if leaf.key == "tracking.fast_threshold")
    assert lowest.high == HIGHEST_THRESHOLD
