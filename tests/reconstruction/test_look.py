"""Pictures and depths laid out by an ideal lens, against surfaces that are known in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from prism_edge.backend.global_map import no_features
from prism_edge.geometry.cameras import FISHEYE, Camera
from prism_edge.reconstruction.look import WIDEST, look
from prism_edge.reconstruction.viewpoints import Viewpoint
from prism_edge.scale.gate import image_pixels, spatial_uncertainty

NONE = np.zeros((0, 0), np.float32)
CAMERAS = {
    "ideal": Camera(640, 480, 520.0, 530.0, 310.0, 250.0),
    "bent": Camera(640, 480, 520.0, 530.0, 310.0, 250.0, "pinhole", (-0.2, 0.05, 0.001, -0.002)),
    "fisheye": Camera(640, 480, 330.0, 330.0, 315.0, 245.0, FISHEYE, (0.01, -0.002, 0.0, 0.0)),
}
NORMAL = np.array([0.2, -0.1, 1.0])  # of a slanted plane: normal . point = 2


def viewpoint(camera: Camera) -> Viewpoint:
    return Viewpoint(7, 5, np.eye(4), camera, np.zeros((0, 2)), np.zeros(0), (), no_features())


def plane_depth(rays: np.ndarray) -> np.ndarray:
    return 2.0 / (rays @ NORMAL[:2] + NORMAL[2])


@pytest.mark.parametrize("name", CAMERAS)
@pytest.mark.parametrize("width", [160, 333, 640, 4000])
def test_depth_and_picture_are_where_their_rays_are(name: str, width: int) -> None:
    """The network's map is another grid than the picture's, and sees the lens's distortion."""
    camera = CAMERAS[name]
    image_to_depth = np.array([0.35, -0.3, 0.31, 0.2])
    x, y = np.meshgrid(np.arange(224.0), np.arange(150.0))
    raw = np.column_stack([(x.ravel() + 0.3) / 0.35, (y.ravel() - 0.2) / 0.31])
    depth = plane_depth(camera.normalise(raw)).reshape(150, 224).astype(np.float32)
    x, y = np.meshgrid(np.arange(640.0), np.arange(480.0))
    seen = plane_depth(camera.normalise(np.column_stack([x.ravel(), y.ravel()]))).reshape(480, 640)
    shade = 60 + 100 * seen / 4
    rgb = np.repeat(np.clip(shade, 0, 255).astype(np.uint8)[..., None], 3, axis=2)
    made = look(viewpoint(camera), rgb, depth, depth + 1, image_to_depth, width)
    small = made.view.camera
    assert small.is_ideal
    assert made.view.depth.shape == made.grey.shape == (small.height, small.width)
    assert small.fx * 640 == pytest.approx(camera.fx * min(width, 640))
    assert small.width == min(width, 640) or not camera.is_ideal
    truth = plane_depth(small.normalise(image_pixels(made.view))).reshape(made.view.depth.shape)
    there = made.view.depth > 0
    # All that the network and the lens see, and no ray from beyond, up to the pixels at the rim.
    rays = camera.normalise(raw[(raw > 4).all(axis=1) & (raw < (635, 475)).all(axis=1)])
    rays = rays[np.hypot(*rays.T) < WIDEST - 0.05]
    column, row = np.rint(small.to_pixels(rays)).astype(int).T
    assert len(rays) > 0.6 * len(raw)
    assert there[row, column].mean() > 0.995
    of = camera.distort_pixels(camera.to_pixels(small.on_plane(image_pixels(made.view))))
    rim = 4 * 640 / min(width, 640)  # is drawn from what is beside it
    inner = ((of > rim) & (of < (639 - rim, 479 - rim))).all(axis=1).reshape(there.shape)
    np.testing.assert_allclose(made.view.depth[there], truth[there], rtol=2e-3)
    np.testing.assert_allclose(made.view.confidence[there], truth[there] + 1, rtol=2e-3)
    grey = 60 + 100 * truth / 4
    assert np.abs(made.grey[there & inner] - grey[there & inner]).max() < 2.5
    assert (made.colours[..., 0] == made.colours[..., 2]).all()


def test_no_ray_from_outside_leads_back_into_the_image_of_a_lens_that_folds_over() -> None:
    camera = Camera(640, 480, 420.0, 420.0, 320.0, 240.0, "pinhole", (-0.28, 0.0, 0.0, 0.0))
    x, y = np.meshgrid(np.arange(640.0), np.arange(480.0))
    depth = plane_depth(camera.normalise(np.column_stack([x.ravel(), y.ravel()]))).reshape(480, 640)
    rgb, as_it_is = np.zeros((480, 640, 3), np.uint8), np.array([1.0, 0.0, 1.0, 0.0])
    made = look(viewpoint(camera), rgb, depth.astype(np.float32), NONE, as_it_is, 640)
    rays = made.view.camera.normalise(image_pixels(made.view))
    there = made.view.depth.ravel() > 0
    assert there.mean() > 0.5
    np.testing.assert_allclose(made.view.depth.ravel()[there], plane_depth(rays[there]), rtol=0.02)
    assert max(made.grey.shape[1] / 640, made.grey.shape[0] / 480) <= 2.0


def test_a_picture_becomes_at_most_twice_as_wide_and_high() -> None:
    """Its corners look 56 degrees off the axis, which this focal length has far outside."""
    camera = Camera(640, 480, 560.0, 560.0, 320.0, 240.0, FISHEYE, (-0.3, 0.0, 0.0, 0.0))
    rgb, depth = np.zeros((480, 640, 3), np.uint8), np.ones((480, 640), np.float32)
    made = look(viewpoint(camera), rgb, depth, NONE, np.array([1.0, 0.0, 1.0, 0.0]), 640)
    assert made.grey.shape == (960, 1280)
    corner = made.view.camera.normalise(np.array([[-0.5, -0.5]]))
    assert corner == pytest.approx(np.array([[-640.5, -480.5]]) / 560.0, abs=1e-9)


def test_a_smaller_picture_ends_where_the_picture_ended() -> None:
    """Its outermost edges, half a pixel beyond the first and the last, are the same rays."""
    camera, depth = CAMERAS["ideal"], np.ones((480, 640), np.float32)
    rgb, whole = np.zeros((480, 640, 3), np.uint8), np.array([1.0, 0.0, 1.0, 0.0])
    small = look(viewpoint(camera), rgb, depth, NONE, whole, 160).view.camera
    ends = [[np.array([[-0.5, -0.5], [c.width - 0.5, c.height - 0.5]])] for c in (small, camera)]
    np.testing.assert_allclose(small.normalise(*ends[0]), camera.normalise(*ends[1]), atol=1e-12)


@pytest.mark.parametrize("masked", [False, True])
def test_what_a_confidence_is_doesnt_change_on_the_way(masked: bool) -> None:
    """An open-ended one that mostly has no idea, which is 1: beside the rim it is no probability of 1."""
    camera = CAMERAS["bent"]
    confidence = np.ones((150, 224), np.float32)
    confidence[:, :90] = 4.0
    if masked:
        confidence[40:60, 120:140] = 0.0
    image_to_depth = np.array([0.35, -0.3, 0.31, 0.2])
    rgb, depth = np.zeros((480, 640, 3), np.uint8), np.ones((150, 224), np.float32)
    made = look(viewpoint(camera), rgb, depth, confidence, image_to_depth, 320)
    u = spatial_uncertainty(made.view.confidence)
    assert np.nanmax(u[:, :120]) < 0.5
    right = u[:, 160:]
    assert np.nanmin(right) > 0.99
    assert np.isnan(right).any() == masked


@pytest.mark.parametrize("name", CAMERAS)
@pytest.mark.parametrize("wide", [4, 11])
def test_what_is_hidden_has_no_depth_however_coarse_the_network_s_map_is(name: str, wide: int) -> None:
    camera, tenth = CAMERAS[name], np.array([0.1, -0.45, 0.1, -0.45])
    shown = np.ones((480, 640), bool)
    shown[:, 301 : 301 + wide] = False
    depth, rgb = np.full((48, 64), 3.0, np.float32), np.zeros((480, 640, 3), np.uint8)
    rgb[~shown] = 255
    made = look(viewpoint(camera), rgb, depth, NONE, tenth, 320, shown)
    whole = look(viewpoint(camera), rgb, depth, NONE, tenth, 320)
    assert not (made.view.depth[made.grey > 130] > 0).any()
    assert (whole.view.depth[made.grey > 130] > 0).any()
    beside = (made.view.depth == 0) & (whole.view.depth > 0)
    assert beside.sum(axis=1).max() <= wide // 2 + 3, "and little beside it"


def test_holes_stay_holes() -> None:
    camera = CAMERAS["ideal"]
    depth = np.full((240, 320), 3.0, np.float32)
    depth[100:140, 150:200] = 0.0
    depth[10:20, 10:20] = np.nan
    halves = np.array([0.5, -0.25, 0.5, -0.25])
    made = look(viewpoint(camera), np.zeros((480, 640, 3), np.uint8), depth, NONE, halves, 320)
    expected = np.where(depth > 0, depth, 0)
    np.testing.assert_allclose(made.view.depth[1:-1, 1:-1], expected[1:-1, 1:-1], atol=1e-5)
    assert made.view.confidence.size == 0


def test_colours_are_red_green_blue() -> None:
    rgb = np.zeros((480, 640, 3), np.uint8)
    rgb[..., 0] = 200
    depth, tenth = np.ones((48, 64), np.float32), np.array([0.1, 0.0, 0.1, 0.0])
    made = look(viewpoint(CAMERAS["ideal"]), rgb, depth, NONE, tenth, 64)
    assert made.colours[20, 30].tolist() == [200, 0, 0]
    assert made.grey[20, 30] == 60  # 0.299 of it


@pytest.mark.parametrize("name", CAMERAS)
def test_an_edge_is_where_its_ray_is_to_a_twentieth_of_a_pixel(name: str) -> None:
    camera = CAMERAS[name]
    rgb = np.zeros((480, 640, 3), np.uint8)
    rgb[:, 400:] = 200  # from half a pixel before column 400
    depth, whole = np.ones((480, 640), np.float32), np.array([1.0, 0.0, 1.0, 0.0])
    made = look(viewpoint(camera), rgb, depth, NONE, whole, 160)
    small = made.view.camera
    row = round(small.cy)
    ray = camera.normalise(np.array([[399.5, camera.cy]]))[0]
    expected = small.project(np.array([[*ray, 1.0]]))[0, 0]
    low, high = round(expected) - 8, round(expected) + 8
    found = high + 0.5 - made.colours[row, low : high + 1, 0].sum() / 200.0
    assert found == pytest.approx(expected, abs=0.05 if name == "ideal" else 0.1)
