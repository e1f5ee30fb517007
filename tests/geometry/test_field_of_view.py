"""What the image shows, against the camera model put to every ideal pixel."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from prism_edge.geometry.cameras import FISHEYE, PINHOLE, Camera
from prism_edge.geometry.field_of_view import FARTHEST, folded, has_ideal_pixel, in_image
from tests.geometry.test_cameras import CAMERAS, IDS

WEBCAM = Camera(640, 480, 450.0, 450.0, 320.0, 240.0, PINHOLE, (-0.35, 0.12, 0.0, 0.0))
EUROC = Camera(752, 480, 458.654, 457.296, 367.215, 248.375, PINHOLE, (-0.2834, 0.07396, 0.000194, 1.76e-5))
WIDE = Camera(640, 480, 300.0, 300.0, 320.0, 240.0, FISHEYE, (-0.01, 0.0, 0.0, 0.0))
ALL = [*CAMERAS, WEBCAM, EUROC, WIDE]
NAMES = [*IDS, "webcam", "euroc", "wide"]


def all_over(camera: Camera, count: int = 41) -> np.ndarray:
    """Pixels as taken, the border left out by a pixel."""
    x, y = np.meshgrid(np.linspace(1, camera.width - 2, count), np.linspace(1, camera.height - 2, count))
    return np.stack([x.ravel(), y.ravel()], axis=1)


@pytest.mark.parametrize("camera", ALL, ids=NAMES)
def test_whatever_the_image_shows_is_in_it(camera: Camera) -> None:
    raw = all_over(camera)
    ideal = camera.undistort_pixels(raw)
    assert np.array_equal(in_image(camera, ideal), has_ideal_pixel(camera, raw, ideal))


@pytest.mark.parametrize("camera", ALL, ids=NAMES)
def test_whatever_lies_beside_it_is_not(camera: Camera) -> None:
    """Rays from the principal point, just within and just beyond where the image ends."""
    centre = np.array([camera.cx, camera.cy])
    for angle in np.linspace(0.01, 0.01 + 2 * np.pi, 48, endpoint=False):  # none along an axis
        way = np.array([np.cos(angle), np.sin(angle)])
        ends = ([0, 0] - centre) / way, ([camera.width, camera.height] - centre) / way
        edge = np.concatenate(ends)
        edge = centre + way * edge[edge > 0].min()
        ideal = camera.undistort_pixels(np.stack([edge]))[0]
        if np.abs(ideal - edge).max() >= 0.9 * FARTHEST * camera.width:
            continue
        within, beyond = centre + 0.995 * (ideal - centre), centre + 1.005 * (ideal - centre)
        assert in_image(camera, np.stack([within, beyond])).tolist() == [True, False]


@given(st.floats(-3000, 4000), st.floats(-3000, 4000))
def test_a_pixel_is_where_the_model_puts_it(x: float, y: float) -> None:
    ideal = np.array([[x, y]])
    raw = WIDE.distort_pixels(ideal)
    expected = np.all((raw >= 0) & (raw < (640, 480)))
    if np.abs(raw - np.clip(raw, 0, (640, 480))).max() > 1e-6 or expected:
        assert in_image(WIDE, ideal)[0] == (expected and np.abs(ideal - raw).max() < FARTHEST * 640)


FOLDING = [
    Camera(640, 480, 330.0, 330.0, 320.0, 240.0, PINHOLE, (-0.33, 0.12, 5e-4, -3e-4, -0.02)),
    Camera(1280, 720, 600.0, 600.0, 640.0, 360.0, PINHOLE, (-0.35, 0.0, 5e-4, -3e-4)),
    Camera(640, 480, 300.0, 300.0, 320.0, 240.0, PINHOLE, (-0.35, 0.0, 0.0, 0.0)),
    Camera(640, 480, 280.0, 280.0, 319.5, 239.5, FISHEYE, (-0.0135, -0.0335, 0.0419, -0.0189)),
    Camera(640, 480, 260.0, 260.0, 319.5, 239.5, FISHEYE, (0.05, -0.12, 0.05, -0.02)),
    Camera(640, 480, 200.0, 200.0, 319.5, 239.5, FISHEYE, (-0.02, -0.01, 0.0, -0.02)),
]


@pytest.mark.parametrize("camera", FOLDING)
def test_of_a_lens_model_that_folds_over_only_rays_that_come_back_count(camera: Camera) -> None:
    """Against the model itself: along a ray from the centre the pixel moves out, until the model folds."""
    for angle in np.linspace(0.01, 0.01 + 2 * np.pi, 24, endpoint=False):
        out = np.linspace(0.0, 2.0 * camera.width, 400)
        ideal = [camera.cx, camera.cy] + out[:, None] * [np.cos(angle), np.sin(angle)]
        raw = camera.distort_pixels(ideal)
        away = np.linalg.norm(raw - [camera.cx, camera.cy], axis=1)
        grows = np.cumprod(np.diff(away, prepend=-1.0) > 0).astype(bool)
        shown = grows & np.all((raw >= 0) & (raw < (camera.width, camera.height)), axis=1)
        claimed = in_image(camera, ideal)
        # Where the model folds its inverse is found to a pixel or not at all: a step or two beside it.
        last = int(np.flatnonzero(shown)[-1])
        assert claimed[: last // 2].all()
        assert not claimed[last + 8 :].any()


# The image's corners alone fold over.
SLIGHTLY = Camera(640, 480, 400.0, 400.0, 320.0, 240.0, PINHOLE, (-0.3, 0.1, 1e-3, -2e-3, -0.02))


@pytest.mark.parametrize("camera", [SLIGHTLY, *FOLDING])
def test_of_a_lens_model_that_folds_over_only_pixels_that_come_back_have_an_ideal_one(camera: Camera) -> None:
    raw = all_over(camera)
    ideal = camera.undistort_pixels(raw)
    back = np.abs(camera.distort_pixels(ideal) - raw).max(axis=1)
    kept = has_ideal_pixel(camera, raw, ideal)
    assert not kept[back >= 1.0].any()
    assert kept[(back < 1.0) & (np.abs(ideal - raw).max(axis=1) < camera.width)].all()
    assert 0 < kept.sum() < len(raw)
    # At the very fold a ray that comes back to the pixel by half of one may come back elsewhere itself.
    assert in_image(camera, ideal[kept]).mean() > 0.995


def test_the_share_of_an_image_that_folds_over() -> None:
    assert folded(SLIGHTLY) == pytest.approx(0.023, abs=0.002)
    assert [folded(camera) for camera in ALL] == [0.0] * len(ALL)


@pytest.mark.parametrize("camera", ALL, ids=NAMES)
def test_of_other_cameras_no_pixel_is_sent_there_and_back(
    camera: Camera, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is done in every frame."""
    raw = all_over(camera)
    ideal = camera.undistort_pixels(raw)
    before = has_ideal_pixel(camera, raw, ideal)
    monkeypatch.setattr(Camera, "distort_pixels", None)
    np.testing.assert_array_equal(has_ideal_pixel(camera, raw, ideal), before)
    far = np.abs(ideal - raw).max(axis=1) >= FARTHEST * max(camera.width, camera.height)
    np.testing.assert_array_equal(before, ~far)


def test_none_gives_none() -> None:
    none = np.zeros((0, 2))
    for camera in (WIDE, SLIGHTLY):
        assert in_image(camera, none).shape == (0,)
        assert has_ideal_pixel(camera, none, none).shape == (0,)


def test_the_first_pixel_beside_an_ideal_image_is_not_in_it() -> None:
    camera = Camera(640, 480, 500.0, 500.0, 319.5, 239.5)
    beside = np.array([[639.9, 10.0], [640.0, 10.0], [10.0, 479.9], [10.0, 480.0], [0.0, 0.0], [-0.1, 5.0]])
    assert in_image(camera, beside).tolist() == [True, False, True, False, True, False]


def test_the_rim_of_a_wider_fisheye_has_no_ideal_pixel_that_is_of_use() -> None:
    """Rays nearly aside: a pixel's noise there is hundreds in the ideal image, whose border none of it is."""
    rim = Camera(640, 480, 230.0, 230.0, 320.0, 240.0, FISHEYE)
    raw = all_over(rim)
    ideal = rim.undistort_pixels(raw)
    near = np.abs(ideal - raw).max(axis=1) < 2.0 * 640
    assert 0.8 < near.mean() < 1.0
    np.testing.assert_array_equal(has_ideal_pixel(rim, raw, ideal), near)
    np.testing.assert_array_equal(in_image(rim, ideal), near)
