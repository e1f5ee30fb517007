"""Pictures of cameras that hang upside down or lie on their side: what networks see of them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from prism_edge.depth.prediction import Prediction
from prism_edge.depth.upright import UprightNetwork, camera_from_turned, turned_back, turned_camera
from prism_edge.geometry.cameras import Camera
from prism_edge.geometry.poses import inverse, transform

CAMERA = Camera(64, 48, 60.0, 55.0, 30.0, 25.0)
WIDE = Camera(64, 48, 60.0, 55.0, 30.0, 25.0, distortion=(-0.1, 0.01, 0.002, -0.001))
TURNS = st.integers(0, 3)


def turned_pixel(x: float, y: float, turns: int) -> tuple[float, float]:
    """Where CAMERA's pixel is after numpy has turned the picture, found by looking for it."""
    picture = np.zeros((CAMERA.height, CAMERA.width))
    picture[int(y), int(x)] = 1.0
    row, column = np.argwhere(np.rot90(picture, turns))[0]
    return float(column), float(row)


@given(TURNS, st.integers(0, 63), st.integers(0, 47), st.floats(0.5, 10.0))
def test_the_turned_camera_sees_a_point_where_the_turned_picture_has_it(
    turns: int, x: int, y: int, range_m: float
) -> None:
    point = range_m * np.array([(x - CAMERA.cx) / CAMERA.fx, (y - CAMERA.cy) / CAMERA.fy, 1.0])
    for _ in range(turns):  # the camera rolls clockwise, and the world the other way
        point = np.array([point[1], -point[0], point[2]])
    camera = turned_camera(CAMERA, turns)
    np.testing.assert_allclose(camera.project(point[None])[0], turned_pixel(x, y, turns), atol=1e-9)
    size = (64, 48) if turns % 2 == 0 else (48, 64)
    assert (camera.width, camera.height) == size


@given(TURNS)
def test_turned_on_and_on_it_is_the_camera_that_it_was(turns: int) -> None:
    assert turned_camera(turned_camera(CAMERA, turns), -turns % 4) == CAMERA


def test_a_lens_stays_with_the_picture_and_out_of_the_turned_camera() -> None:
    assert turned_camera(WIDE, 2).distortion == ()


class Reader:
    """A network of 20 x 30 whose depth is written in the picture's red, and that crops half a pixel off."""

    name, identity, provider = "reader", "reader@0123456789ab", "CPUExecutionProvider"
    bias_sigma, dsug = 0.05, (1.0, 2.0)

    def __init__(self) -> None:
        self.counters: dict[str, int] = {"seen": 0}

    def infer(self, rgb: np.ndarray, camera: Camera) -> Prediction:
        assert rgb.shape == (camera.height, camera.width, 3)
        assert rgb.flags.c_contiguous
        self.counters["seen"] += 1
        a, c = 30 / camera.width, 20 / camera.height
        b, d = 0.5 * a - 1.0, 0.5 * c - 0.25
        v, u = np.mgrid[0:20, 0:30]
        x = np.clip(np.rint((u - b) / a), 0, camera.width - 1).astype(int)
        y = np.clip(np.rint((v - d) / c), 0, camera.height - 1).astype(int)
        depth = rgb[y, x, 0].astype(np.float32)
        return Prediction(depth, np.array([a, b, c, d]), depth / 1000, np.ones(3, np.float32), 1.0)


@given(TURNS)
def test_depth_comes_back_to_the_pixels_that_it_is_of(turns: int) -> None:
    """A picture whose red says the column or the row is read off where it was, to half a pixel of depth."""
    columns = np.broadcast_to(np.arange(64, dtype=np.uint8), (48, 64))
    rows = np.broadcast_to(np.arange(48, dtype=np.uint8)[:, None], (48, 64))
    network = UprightNetwork(Reader(), turns)
    for axis, said in enumerate((columns, rows)):
        answer = network.infer(np.dstack([said, said, said]), CAMERA)
        a, b, c, d = answer.image_to_depth
        for x, y in ((10, 10), (40, 10), (25, 38), (50, 40)):
            v, u = round(c * y + d), round(a * x + b)
            assert abs(float(answer.depth[v, u]) - (x, y)[axis]) <= 2.0
            assert answer.confidence[v, u] == answer.depth[v, u] / np.float32(1000)
        assert answer.depth.shape == ((20, 30) if turns % 2 == 0 else (30, 20))
        assert answer.depth.flags.c_contiguous
        assert answer.confidence.flags.c_contiguous


def test_what_is_no_picture_stays_as_it_was() -> None:
    without = Prediction(
        np.zeros((20, 30), np.float32), np.ones(4), np.zeros((0, 0), np.float32), np.ones(3, np.float32), 7.0
    )
    back = turned_back(without, 2, CAMERA)
    assert back.confidence.shape == (0, 0)
    assert (back.inference_ms, back.valid, back.descriptor.tolist()) == (7.0, True, [1.0, 1.0, 1.0])


def test_it_is_the_network_but_for_whose_answers_its_are_compared_with() -> None:
    inner = Reader()
    upright = UprightNetwork(inner, 2)
    assert (upright.name, upright.provider) == (inner.name, inner.provider)
    assert (upright.bias_sigma, upright.dsug) == (inner.bias_sigma, inner.dsug)
    assert upright.identity not in (inner.identity, UprightNetwork(inner, 1).identity)
    upright.infer(np.zeros((48, 64, 3), np.uint8), CAMERA)
    assert upright.counters == {"seen": 1}


@pytest.mark.parametrize("turns", [0, 1, 2, 3])
def test_the_turned_camera_sees_a_point_where_the_turned_picture_shows_it(turns: int) -> None:
    camera = Camera(64, 48, 60.0, 50.0, 30.0, 25.0)
    point = np.array([[0.3, -0.2, 1.7]])
    column, row = np.rint(camera.project(point)[0]).astype(int)
    picture = np.zeros((48, 64))
    picture[row, column] = 1.0
    seen = transform(inverse(camera_from_turned(turns)), point)
    expected = np.argwhere(np.rot90(picture, turns) == 1.0)[0][::-1]
    np.testing.assert_allclose(turned_camera(camera, turns).project(seen)[0], expected, atol=0.51)
    there_and_back = np.linalg.matrix_power(camera_from_turned(1), 4)
    np.testing.assert_allclose(there_and_back, np.eye(4), atol=1e-12)
