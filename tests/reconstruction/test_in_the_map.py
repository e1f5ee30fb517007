"""Depth held to a map's points, where by how much it is off is known."""

from __future__ import annotations

import numpy as np
import pytest

from prism_edge.backend.global_map import no_features
from prism_edge.geometry.cameras import Camera
from prism_edge.reconstruction import in_the_map
from prism_edge.reconstruction.in_the_map import aligned, from_relative, shown_in
from prism_edge.reconstruction.viewpoints import Viewpoint

CAMERA = Camera(640, 480, 520.0, 520.0, 319.5, 239.5)
TO_DEPTH = np.array([0.5, -0.25, 0.5, -0.25])
Y, X = np.mgrid[0:240, 0:320]
DEPTH = (2.0 + 1.5 * np.sin(X / 40.0) * np.cos(Y / 50.0)).astype(np.float32)  # metres, smooth


def viewpoint(count: int = 300, seed: int = 0) -> Viewpoint:
    """Points of the true surface, at pixels of the depth map's own grid."""
    rng = np.random.default_rng(seed)
    x, y = rng.integers(2, 318, count), rng.integers(2, 238, count)
    pixels = np.column_stack([(x + 0.25) / 0.5, (y + 0.25) / 0.5])
    depths = DEPTH[y, x].astype(np.float64)
    return Viewpoint(0, 0, np.eye(4), CAMERA, pixels, depths, (), no_features())


def test_a_networks_unit_becomes_the_map_s() -> None:
    for factor in (0.3, 1.0, 40.0):
        made = aligned(DEPTH * np.float32(factor), TO_DEPTH, viewpoint())
        assert made is not None
        np.testing.assert_allclose(made, DEPTH, rtol=1e-5)


def test_a_ratio_that_wavers_from_place_to_place_is_followed() -> None:
    off = np.exp(0.12 * np.sin(X / 60.0)).astype(np.float32)
    made = aligned(DEPTH * off, TO_DEPTH, viewpoint(800))
    assert made is not None
    before, after = (np.abs(np.log(d / DEPTH)) for d in (DEPTH * off, made))
    assert np.median(after) < 0.25 * np.median(before)


def test_measured_depth_is_brought_over_by_one_ratio() -> None:
    off = np.exp(0.12 * np.sin(X / 60.0)).astype(np.float32)
    made = aligned(3 * DEPTH * off, TO_DEPTH, viewpoint(800), as_a_whole=True)
    assert made is not None
    ratio = made / (DEPTH * off)
    np.testing.assert_allclose(ratio, ratio[0, 0], rtol=1e-6)
    assert abs(np.log(ratio[0, 0])) < 0.13


def test_wrong_points_hardly_matter() -> None:
    view = viewpoint()
    view.depths[::40] *= 4.0
    made = aligned(DEPTH, TO_DEPTH, view)
    assert made is not None
    assert np.median(np.abs(np.log(made / DEPTH))) < 0.02


def test_holes_stay_and_their_points_are_not_asked() -> None:
    holed = DEPTH.copy()
    holed[:, :100] = 0.0
    made = aligned(holed, TO_DEPTH, viewpoint())
    assert made is not None
    assert (made[:, :100] == 0).all()
    np.testing.assert_allclose(made[:, 101:], DEPTH[:, 101:], rtol=1e-5)


def test_no_depth_at_all_is_none() -> None:
    assert aligned(np.zeros_like(DEPTH), TO_DEPTH, viewpoint()) is None


def test_too_few_points_are_none() -> None:
    assert aligned(DEPTH, TO_DEPTH, viewpoint(19)) is None
    assert aligned(DEPTH, TO_DEPTH, viewpoint(0)) is None
    assert from_relative(1 / DEPTH, TO_DEPTH, viewpoint(50), True) is None
    assert from_relative(1 / DEPTH, TO_DEPTH, viewpoint(0), True) is None


def test_inverse_depth_gets_its_scale_and_its_shift() -> None:
    relative = (7.0 / DEPTH - 3.0).astype(np.float32)
    made = from_relative(relative, TO_DEPTH, viewpoint(), True)
    assert made is not None
    np.testing.assert_allclose(made, DEPTH, rtol=1e-3)


def test_inverse_depth_is_none_where_it_says_none_or_far_beyond_the_points() -> None:
    relative = (7.0 / DEPTH).astype(np.float32)
    relative[:20] = np.nan  # sky
    relative[20:40] = 0.001  # seven kilometres
    made = from_relative(relative, TO_DEPTH, viewpoint(600), True)
    assert made is not None
    assert (made[:40] == 0).all()
    np.testing.assert_allclose(made[40:], DEPTH[40:], rtol=0.05)


def test_what_grows_with_depth_is_no_inverse_depth() -> None:
    assert from_relative(DEPTH, TO_DEPTH, viewpoint(), True) is None


@pytest.mark.parametrize("shift", [-1.5, 0.0, 3.0])
def test_relative_depth_gets_its_scale_and_its_shift(shift: float) -> None:
    """Also where it lies below 0, but for exactly 0, which is none."""
    said = (0.4 * DEPTH + shift).astype(np.float32)
    said[:10] = 0.0
    made = from_relative(said, TO_DEPTH, viewpoint(600), False)
    assert made is not None
    assert (made[:10] == 0).all()
    assert np.median(np.abs(made[10:] / DEPTH[10:] - 1)) < 0.01
    assert (made[10:] > 0).mean() > 0.99


def test_infinite_relative_depth_is_none_by_its_inverse_too() -> None:
    said = (1.0 / (0.4 / DEPTH - 0.08)).astype(np.float32)  # 1 / inf would be 5 m
    said[:10] = np.inf
    made = from_relative(said, TO_DEPTH, viewpoint(600), False)
    assert made is not None
    assert (made[:10] == 0).all()
    assert np.median(np.abs(made[10:] / DEPTH[10:] - 1)) < 0.01


def test_in_a_coarse_depth_map_no_step_skips_what_points_say(monkeypatch: pytest.MonkeyPatch) -> None:
    """A pixel of it is ten of the image, in which a point's ratio holds for 25."""
    off = np.exp(0.12 * np.sin(X / 15.0)).astype(np.float32)
    coarse = (DEPTH * off)[2::5, 2::5], np.array([0.1, -0.45, 0.1, -0.45])
    made = aligned(*coarse, viewpoint(2000))
    monkeypatch.setattr(in_the_map, "_STEP", 1)
    at_each = aligned(*coarse, viewpoint(2000))
    assert made is not None
    assert at_each is not None
    assert np.std(np.log(made / at_each)) < 0.005


def test_large_maps_are_aligned_in_portions(monkeypatch: pytest.MonkeyPatch) -> None:
    off = np.exp(0.12 * np.sin(X / 60.0)).astype(np.float32)
    whole = aligned(DEPTH * off, TO_DEPTH, viewpoint(800))
    monkeypatch.setattr(in_the_map, "_AT_ONCE", 100)
    np.testing.assert_array_equal(aligned(DEPTH * off, TO_DEPTH, viewpoint(800)), whole)


def test_a_mask_is_laid_where_the_image_lies_in_a_padded_depth_map() -> None:
    """Ten columns and five rows of padding about an image that was halved; its left half shows the world."""
    shown = np.zeros((480, 640), bool)
    shown[:, :320] = True
    made = shown_in(shown, (250, 340), np.array([0.5, 10.0, 0.5, 5.0]))
    expected = np.zeros((250, 340), bool)
    expected[5:245, 10:170] = True
    np.testing.assert_array_equal(made, expected)
