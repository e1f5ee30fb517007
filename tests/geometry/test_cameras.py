"""Camera models against OpenCV's, and against their own inverse."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from prism_edge.errors import ConfigError
from prism_edge.geometry.cameras import FISHEYE, PINHOLE, Camera
from prism_edge.geometry.field_of_view import folded
from tests.geometry.by_opencv import undistorted

FREIBURG1 = (0.262383, -0.953104, -0.005358, 0.002628, 1.163314)
FREIBURG2 = (0.231222, -0.784899, -0.003257, -0.000105, 0.917205)
RATIONAL = (0.45, 0.12, 0.0006, -0.0004, 0.01, 0.78, 0.21, 0.03)


def vga(model: str = PINHOLE, distortion: tuple[float, ...] = ()) -> Camera:
    return Camera(640, 480, 517.3, 516.5, 318.6, 255.3, model, distortion)


CAMERAS = [
    vga(),
    vga(distortion=(-0.28, 0.07, 0.0002, -0.0003)),
    vga(distortion=FREIBURG1),
    vga(distortion=FREIBURG2),
    vga(distortion=RATIONAL),
    vga(FISHEYE),
    Camera(640, 480, 300.0, 301.0, 321.0, 239.0, FISHEYE, (-0.012, 0.04, -0.03, 0.006)),
]
IDS = ["ideal", "radtan4", "freiburg1", "freiburg2", "rational", "fisheye-plain", "fisheye"]


def image_grid(camera: Camera) -> np.ndarray:
    """Pixels all over the image, its corners included."""
    x, y = np.meshgrid(np.linspace(0, camera.width - 1, 17), np.linspace(0, camera.height - 1, 13))
    return np.stack([x.ravel(), y.ravel()], axis=1)


def opencv_projection(camera: Camera, points: np.ndarray) -> np.ndarray:
    if camera.model == FISHEYE:
        k = np.array(camera.distortion or (0.0,) * 4)
        pixels, _ = cv2.fisheye.projectPoints(points[:, None], np.zeros(3), np.zeros(3), camera.matrix, k)
    else:
        k = np.array(camera.distortion or (0.0,) * 4)
        pixels, _ = cv2.projectPoints(points[:, None], np.zeros(3), np.zeros(3), camera.matrix, k)
    return pixels[:, 0]


@pytest.mark.parametrize("camera", CAMERAS, ids=IDS)
def test_projection_agrees_with_opencv(camera: Camera) -> None:
    rng = np.random.default_rng(0)
    depth = rng.uniform(0.3, 30.0, 200)
    points = np.stack([rng.uniform(-0.6, 0.6, 200) * depth, rng.uniform(-0.45, 0.45, 200) * depth, depth], 1)
    np.testing.assert_allclose(camera.project(points), opencv_projection(camera, points), atol=1e-6)


@pytest.mark.parametrize("camera", CAMERAS, ids=IDS)
def test_normalised_pixels_project_back_by_opencv(camera: Camera) -> None:
    pixels = image_grid(camera)
    rays = np.column_stack([camera.normalise(pixels), np.ones(len(pixels))])
    np.testing.assert_allclose(opencv_projection(camera, rays), pixels, atol=1e-6)


@pytest.mark.parametrize("camera", CAMERAS, ids=IDS)
def test_undistortion_agrees_with_opencv(camera: Camera) -> None:
    pixels = image_grid(camera)
    k = np.array(camera.distortion or (0.0,) * 4)
    if camera.model == FISHEYE:
        expected = cv2.fisheye.undistortPoints(pixels[:, None], camera.matrix, k)[:, 0]
    else:
        expected = undistorted(pixels, camera.matrix, k, np.eye(3))
    np.testing.assert_allclose(camera.normalise(pixels), expected, atol=1e-6)


@settings(max_examples=60, deadline=None)
@given(
    index=st.integers(0, len(CAMERAS) - 1),
    x=st.floats(0.0, 639.0),
    y=st.floats(0.0, 479.0),
    depth=st.floats(0.05, 500.0),
)
def test_normalise_undoes_project(index: int, x: float, y: float, depth: float) -> None:
    camera = CAMERAS[index]
    point = np.append(camera.normalise(np.array([[x, y]]))[0], 1.0)[None] * depth
    np.testing.assert_allclose(camera.project(point), [[x, y]], atol=1e-6)


@pytest.mark.parametrize("camera", CAMERAS, ids=IDS)
def test_undistorted_pixels_are_what_the_ideal_camera_sees(camera: Camera) -> None:
    pixels = image_grid(camera)
    rays = np.column_stack([camera.normalise(pixels), np.ones(len(pixels))])
    ideal = camera.ideal()
    assert ideal.is_ideal
    np.testing.assert_allclose(camera.undistort_pixels(pixels), ideal.project(rays), atol=1e-6)


@pytest.mark.parametrize(
    "lens",
    [
        # 140 degrees from corner to corner; the first is equidistant there. No slope is less than 0.1.
        (0.8105, 0.1188, 0.0008, -0.0012, 0.0016, 1.1437, 0.3008, 0.0140),
        (-0.1765, 0.0146, 0.0008, -0.0012),
    ],
)
def test_far_off_its_axis_a_lens_is_undone_too(lens: tuple[float, ...]) -> None:
    camera = Camera(640, 480, 327.4, 327.4, 321.0, 239.0, distortion=lens)
    v, u = np.mgrid[0:480:8, 0:640:8].astype(float)
    pixels = np.column_stack([u.ravel(), v.ravel()])
    assert camera.distort_pixels(camera.undistort_pixels(pixels)) == pytest.approx(pixels, abs=1e-6)
    assert folded(camera) == 0.0


def test_fisheye_far_off_axis_has_no_negative_ray() -> None:
    # wider than the plane z = 1 reaches: the ray must stay on the pixel's own side
    camera = Camera(1280, 960, 260.0, 260.0, 640.0, 480.0, FISHEYE, (0.0, 0.0, 0.0, 0.0))
    corner = camera.normalise(np.array([[1279.0, 480.0], [0.0, 480.0]]))
    assert np.all(np.isfinite(corner))
    assert corner[0, 0] > 1.0
    assert corner[1, 0] < -1.0


def test_the_principal_point_is_the_optical_axis() -> None:
    for camera in CAMERAS:
        np.testing.assert_allclose(camera.normalise(np.array([[camera.cx, camera.cy]])), 0.0, atol=1e-12)
        np.testing.assert_allclose(
            camera.project(np.array([[0.0, 0.0, 2.0]])), [[camera.cx, camera.cy]], atol=1e-12
        )


@pytest.mark.parametrize("camera", CAMERAS, ids=IDS)
def test_a_camera_survives_its_array(camera: Camera) -> None:
    values = camera.to_array()
    assert values.dtype == np.float64
    assert Camera.from_array(camera.model, values) == camera
    assert Camera.from_array(camera.model, values).readout_ms is None


@pytest.mark.parametrize(
    "values",
    [
        [],
        [640, 480, 500, 500, 320],
        [640.5, 480, 500, 500, 320, 240],
        [640, 480, -500, 500, 320, 240],
        [640, 480, 500, 500, np.nan, 240],
        [640, 480, 500, 500, 320, 240, 0.1],
        [np.inf, 480, 500, 500, 320, 240],
    ],
)
def test_arrays_that_describe_no_camera_are_refused(values: list[float]) -> None:
    with pytest.raises(ConfigError):
        Camera.from_array(PINHOLE, np.array(values, dtype=np.float64))


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"fx": 0.0}, "focal"),
        ({"fy": -1.0}, "focal"),
        ({"cx": float("nan")}, "finite"),
        ({"width": 0}, "size"),
        ({"model": "omni"}, "omni"),
        ({"distortion": (0.1, 0.2)}, "coefficients"),
        ({"model": FISHEYE, "distortion": (0.1,) * 5}, "coefficients"),
        ({"fx": 63.9, "fy": 63.9}, "fx: 63.9 pixels"),
        ({"fx": 100.0, "fy": 63.9}, "fy: 63.9 pixels"),
        ({"fx": 12801.0, "fy": 12801.0}, "fx: 12801 pixels"),
        ({"fx": 0.00525, "fy": 0.00525}, "fx: 0.00525 pixels"),  # metres
        ({"fy": 1001.0}, "fx: 500 doesn't go with fy 1001"),
        ({"fy": 249.0}, "fx: 500 doesn't go with fy 249"),
        ({"cx": 1319.5}, "cx: 1319.5 lies outside the image, which is 640 pixels wide"),
        ({"cx": -1.5}, "cx: -1.5"),
        ({"cy": 481.0}, "cy: 481 lies outside the image, which is 480 pixels high"),
        ({"cy": -320.0}, "cy: -320"),
    ],
)
def test_impossible_cameras_are_refused(changes: dict[str, object], word: str) -> None:
    values = {"width": 640, "height": 480, "fx": 500.0, "fy": 500.0, "cx": 320.0, "cy": 240.0} | changes
    with pytest.raises(ConfigError, match=word):
        Camera(**values)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "changes",
    [
        {"fx": 64.0, "fy": 64.0},
        {"fx": 12800.0, "fy": 12800.0},
        {"fy": 1000.0},
        {"fy": 250.0},
        {"cx": 0.0, "cy": 480.0},
        {"cx": 640.0, "cy": -0.5},
    ],
)
def test_rare_cameras_are_possible(changes: dict[str, float]) -> None:
    values = {"width": 640, "height": 480, "fx": 500.0, "fy": 500.0, "cx": 320.0, "cy": 240.0} | changes
    assert Camera(**values).width == 640  # type: ignore[arg-type]


@pytest.mark.parametrize("camera", CAMERAS[:5], ids=IDS[:5])
def test_a_bent_camera_is_like_what_it_was(camera: Camera) -> None:
    bent = camera.bent(-0.02)
    assert bent != camera
    assert bent.like(camera)
    assert camera.like(bent)
    assert bent.bent(0.02).project(np.array([[0.3, 0.2, 1.0]])) == pytest.approx(
        camera.project(np.array([[0.3, 0.2, 1.0]])), abs=1e-9
    )


@pytest.mark.parametrize(
    "other",
    [
        replace(vga(), width=320),
        replace(vga(), fx=518.0),
        replace(vga(), cx=318.0),
        vga(FISHEYE),
        vga(distortion=(0.0, 0.1, 0.0, 0.0)),
        vga(distortion=(0.5, 0.0, 0.0, 0.0)),
    ],
)
def test_another_camera_is_not_like_it(other: Camera) -> None:
    assert not vga().like(other)
    assert not other.like(vga())


def test_a_fisheye_is_like_itself_alone() -> None:
    assert CAMERAS[-1].like(CAMERAS[-1])
    assert not CAMERAS[-1].like(replace(CAMERAS[-1], distortion=(-0.013, 0.04, -0.03, 0.006)))


@settings(max_examples=100, deadline=None)
@given(st.sampled_from(CAMERAS[:5]), st.floats(-0.06, 0.06), st.floats(-0.5, 0.5), st.floats(-0.4, 0.4))
def test_ideal_pixels_of_another_lens_are_of_the_same_image(
    camera: Camera, k1: float, x: float, y: float
) -> None:
    lens, ray = camera.bent(k1), np.array([[x, y, 1.0]])
    wrong = camera.undistort_pixels(lens.project(ray))  # what one who doesn't know the lens makes of it
    assert lens.pixels_of(camera, wrong) == pytest.approx(lens.ideal().project(ray), abs=1e-4)
