"""Pictures of strongly bent lenses: what networks see of them, and where their depths come back."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from prism_edge.depth.prediction import Prediction
from prism_edge.depth.straight import WIDEST_DEG, as_shown, bent_back, set_straight, straight_camera
from prism_edge.depth.upright import UprightNetwork
from prism_edge.errors import ModelError
from prism_edge.geometry.cameras import FISHEYE, Camera
from tests.geometry.test_cameras import FREIBURG1, FREIBURG2

BARREL = Camera(188, 120, 114.6, 114.3, 91.8, 62.1, distortion=(-0.283, 0.074, 0.0002, 0.00002))
FISH = Camera(160, 120, 72.0, 72.0, 81.0, 58.0, FISHEYE, (-0.01, 0.005, -0.002, 0.0))
BENT = pytest.mark.parametrize("camera", [BARREL, FISH], ids=["barrel", "fisheye"])
RAYS = np.array([[0.0, 0.0, 1.0], [0.5, -0.3, 1.0], [-0.6, 0.2, 1.0], [0.3, 0.4, 1.0]])


class Columns:
    """A network of 40 x 30 whose depth is 1 m and a centimetre for each column of the picture it is shown."""

    name, identity, provider = "columns", "columns@0123456789ab", "CPUExecutionProvider"
    bias_sigma, dsug = 0.05, (1.0, 2.0)

    def __init__(self) -> None:
        self.counters: dict[str, int] = {"seen": 0}
        self.cameras: list[Camera] = []

    def infer(self, rgb: np.ndarray, camera: Camera) -> Prediction:
        assert rgb.shape == (camera.height, camera.width, 3)
        assert rgb.flags.c_contiguous
        self.counters["seen"] += 1
        self.cameras.append(camera)
        a, c = 40 / camera.width, 30 / camera.height
        column = (np.arange(40) + 0.5) / a - 0.5
        depth = np.broadcast_to(1.0 + 0.01 * column, (30, 40)).astype(np.float32)
        to_depth = np.array([a, 0.5 * a - 0.5, c, 0.5 * c - 0.5])
        return Prediction(depth, to_depth, depth / 10, np.ones(3, np.float32), 1.0)


def picture(camera: Camera) -> np.ndarray:
    return np.zeros((camera.height, camera.width, 3), np.uint8)


@BENT
def test_its_picture_shows_what_the_camera_saw_and_nothing_too_far_aside(camera: Camera) -> None:
    straight = straight_camera(camera)
    assert straight.is_ideal
    assert straight.width == camera.width
    x, y = np.meshgrid([0.0, straight.width / 2, straight.width - 1.0], [0.0, straight.height - 1.0])
    rays = straight.on_plane(np.column_stack([x.ravel(), y.ravel()]))
    assert np.abs(rays).max() <= math.tan(math.radians(WIDEST_DEG)) + 1e-9
    seen = camera.project(np.column_stack([rays, np.ones(len(rays))]))
    assert (seen > -0.5).all()
    assert (seen < (camera.width, camera.height)).all()  # as field_of_view.py has it


@pytest.mark.parametrize(
    "distortion", [(), (-0.03, 0.0, 0.0, 0.0), FREIBURG1, FREIBURG2], ids=["none", "found", "fr1", "fr2"]
)
def test_what_is_hardly_bent_is_shown_as_it_is(distortion: tuple[float, ...]) -> None:
    camera, network = Camera(640, 480, 517.3, 516.5, 318.6, 255.3, distortion=distortion), Columns()
    assert straight_camera(camera) == camera
    assert as_shown(network, camera) is network


def test_through_a_lens_that_folds_over_it_is_shown_as_it_is() -> None:
    folding = Camera(640, 480, 400.0, 400.0, 320.0, 240.0, distortion=(-0.9, 0.0, 0.0, 0.0))
    assert straight_camera(folding) == folding


def test_a_cut_of_an_image_that_lacks_its_middle_is_shown_as_it_is() -> None:
    for cut in (replace(BARREL, cx=-0.9), replace(FISH, cy=120.0)):
        assert straight_camera(cut) == cut


@pytest.mark.filterwarnings("error")
@settings(max_examples=200, deadline=None)
@given(
    kind=st.sampled_from([FISHEYE, "pinhole"]),
    focal=st.floats(0.3, 1.5),
    middle=st.tuples(st.floats(-1.0, 160.0), st.floats(-1.0, 120.0)),
    distortion=st.lists(st.floats(-0.5, 0.5), min_size=4, max_size=4),
)
def test_of_any_camera_there_is_a_straight_one_or_itself(kind, focal, middle, distortion) -> None:
    """A camera that can't be would fail every keyframe."""
    camera = Camera(160, 120, 160 * focal, 160 * focal, *middle, kind, tuple(distortion))
    straight = straight_camera(camera)
    assert straight == camera or straight.is_ideal


@BENT
def test_points_are_where_an_ideal_camera_has_them(camera: Camera) -> None:
    straight = straight_camera(camera)
    row, column = np.mgrid[: camera.height, : camera.width]
    for point in RAYS:
        (u, v), = camera.project(point[None])
        dot = 255.0 * np.exp(-((column - u) ** 2 + (row - v) ** 2) / 5.0)
        seen = set_straight(np.dstack([dot] * 3).astype(np.uint8), camera, straight)[:, :, 1]
        assert seen.shape == (straight.height, straight.width)
        weight = seen / seen.sum(dtype=np.float64)
        at = (weight.sum(axis=0) @ np.arange(straight.width), weight.sum(axis=1) @ np.arange(straight.height))
        assert at == pytest.approx(straight.project(point[None])[0], abs=0.4)  # a dot is bent itself


@BENT
@settings(deadline=None)
@given(x=st.floats(-0.7, 0.7), y=st.floats(-0.5, 0.5))
def test_depth_comes_back_to_the_pixels_that_it_is_of(camera: Camera, x: float, y: float) -> None:
    straight, point = straight_camera(camera), np.array([[x, y, 1.0]])
    answer = as_shown(Columns(), camera).infer(picture(camera), camera)
    assert answer.depth.shape == (30, 40)
    a, b, c, d = answer.image_to_depth
    (u, v), = camera.project(point)
    said = answer.depth[round(c * v + d), round(a * u + b)]
    pixel = straight.project(point)[0]
    if ((pixel < 4.0) | (pixel > (straight.width - 5.0, straight.height - 5.0))).any():
        return  # the map's own pixels are four or five of these
    assert said == pytest.approx(1.0 + 0.01 * pixel[0], abs=0.08)
    assert answer.confidence[round(c * v + d), round(a * u + b)] == said / np.float32(10)


def test_what_the_straight_picture_does_not_show_has_no_depth_and_nothing_is_known_of_it() -> None:
    straight = straight_camera(FISH)
    answer = Columns().infer(picture(straight), straight)
    beside = bent_back(answer, FISH, straight)
    assert beside.depth[15, 0] == 0.0  # 64 degrees off the axis
    assert np.isnan(beside.confidence[15, 0])  # a probability of 0 would be held against what is there
    assert (np.isnan(beside.confidence) == (beside.depth == 0.0)).all()
    assert 0.4 < np.mean(beside.depth > 0) < 0.7


def test_a_picture_of_another_size_is_refused() -> None:
    with pytest.raises(ModelError, match=r"image \(60, 80, 3\) is not of its camera \(120, 160, 3\)"):
        as_shown(Columns(), FISH).infer(np.zeros((60, 80, 3), np.uint8), FISH)


def test_no_confidence_stays_none() -> None:
    straight = straight_camera(FISH)
    answer = replace(Columns().infer(picture(straight), straight), confidence=np.zeros((0, 0), np.float32))
    assert bent_back(answer, FISH, straight).confidence.shape == (0, 0)


def test_it_is_the_network_but_for_whose_answers_its_are_compared_with() -> None:
    inner = Columns()
    shown = as_shown(inner, FISH)
    assert (shown.name, shown.provider) == (inner.name, inner.provider)
    assert (shown.bias_sigma, shown.dsug) == (inner.bias_sigma, inner.dsug)
    assert shown.identity == f"{inner.identity}+straight"
    shown.infer(picture(FISH), FISH)
    assert shown.counters == {"seen": 1}
    assert inner.cameras == [straight_camera(FISH)]


@pytest.mark.parametrize("turns", [1, 2, 3])
def test_a_camera_on_its_side_has_its_pictures_set_straight_first(turns: int) -> None:
    inner = Columns()
    answer = as_shown(UprightNetwork(inner, turns), FISH).infer(picture(FISH), FISH)
    (seen,) = inner.cameras
    straight = straight_camera(FISH)
    size = (straight.width, straight.height)
    assert (seen.width, seen.height) == (size if turns == 2 else size[::-1])
    assert seen.is_ideal
    assert answer.depth.shape == ((30, 40) if turns == 2 else (40, 30))
    a, b, c, d = answer.image_to_depth
    (u, v), = FISH.project(np.array([[0.4, 0.1, 1.0]]))
    expected = np.array(straight.project(np.array([[0.4, 0.1, 1.0]]))[0])
    along = {1: expected[1], 2: size[0] - 1 - expected[0], 3: size[1] - 1 - expected[1]}[turns]
    said = answer.depth[round(c * v + d), round(a * u + b)]
    assert said == pytest.approx(1.0 + 0.01 * along, abs=0.08)
