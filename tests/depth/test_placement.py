"""Where the image lies in the network's input, judged by where a spot really lands."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from prism_edge.depth.contract import KEPT, SPREAD
from prism_edge.depth.placement import levels, place, tensor
from prism_edge.geometry.cameras import Camera
from tests.synthetic.network import TinyNetwork

CARD = TinyNetwork().card()


def spot(width: int, height: int, x: float, y: float, sigma: float = 6.0) -> np.ndarray:
    """RGB image with a bright Gaussian spot at (x, y)."""
    dx, dy = np.arange(width) - x, np.arange(height)[:, None] - y
    value = 255.0 * np.exp(-(dx**2 + dy**2) / (2 * sigma**2))
    return np.repeat(np.round(value).astype(np.uint8)[:, :, None], 3, axis=2)


def centroid(plane: np.ndarray) -> tuple[float, float]:
    weights = plane / plane.sum()
    rows, columns = np.arange(plane.shape[0]), np.arange(plane.shape[1])
    return float(weights.sum(0) @ columns), float(weights.sum(1) @ rows)


@settings(max_examples=30, deadline=None)
@given(
    width=st.integers(160, 500),
    height=st.integers(160, 500),
    input_width=st.integers(100, 400),
    input_height=st.integers(100, 400),
    resize=st.sampled_from(["stretch", "crop"]),
    off=st.tuples(st.floats(-20, 20), st.floats(-20, 20)),
)
def test_a_spot_lands_where_image_to_depth_says(width, height, input_width, input_height, resize, off):
    card = replace(CARD, input_width=input_width, input_height=input_height, resize=resize)
    placement = place(card, width, height)
    x, y = width / 2 + off[0], height / 2 + off[1]
    values = tensor(spot(width, height, x, y), card, placement)
    assert values.shape == (1, 3, input_height, input_width)
    assert values.dtype == np.float32
    a, b, c, d = placement.image_to_depth(input_width, input_height)
    found = centroid(values[0, 0])
    low, high = 30 * max(a, c), min(input_width, input_height) - 30 * max(a, c)
    if low < a * x + b < high and low < c * y + d < high:  # else the crop cuts the spot
        assert found == pytest.approx((a * x + b, c * y + d), abs=0.06)


@pytest.mark.parametrize("resize", ["stretch", "crop"])
@pytest.mark.parametrize("size", [(336, 252), (252, 336)])
def test_the_camera_of_the_input_sees_each_ray_where_the_image_lies_in_it(size, resize):
    camera = Camera(640, 480, 510.0, 470.0, 300.5, 251.25)
    card = replace(CARD, input_width=size[0], input_height=size[1], resize=resize)
    placement = place(card, camera.width, camera.height)
    a, b, c, d = placement.image_to_depth(*size)
    fx, fy, cx, cy = placement.to_input(camera)
    for ray in ((0.0, 0.0, 1.0), (0.3, -0.2, 1.0), (-0.7, 0.9, 2.0)):
        x, y = camera.project(np.array([ray]))[0]
        seen = fx * ray[0] / ray[2] + cx, fy * ray[1] / ray[2] + cy
        assert seen == pytest.approx((a * x + b, c * y + d), abs=1e-9)
    there = placement.to_image(fx, fy, cx, cy)
    assert there == pytest.approx([camera.fx, camera.fy, camera.cx, camera.cy])
    assert placement.focal_length(camera) == pytest.approx(np.sqrt(fx * fy))


def test_a_depth_map_of_another_size_keeps_corners_on_corners():
    placement = place(CARD, 640, 480)
    a, b, c, d = placement.image_to_depth(80, 60)
    # the image's outer corners, half a pixel beyond the outermost centres
    assert (a * -0.5 + b, c * -0.5 + d) == pytest.approx((-0.5, -0.5))
    assert (a * 639.5 + b, c * 479.5 + d) == pytest.approx((79.5, 59.5))


def test_crop_keeps_the_aspect_and_the_centre():
    placement = place(replace(CARD, input_width=224, input_height=224, resize="crop"), 640, 480)
    assert placement.scale_x == pytest.approx(placement.scale_y, rel=0.01)
    a, b, c, d = placement.image_to_depth(224, 224)
    assert (a * 319.5 + b, c * 239.5 + d) == pytest.approx((111.5, 111.5), abs=0.51)


def test_normalisation_and_order_of_colours():
    card = replace(CARD, mean=(0.1, 0.2, 0.3), std=(0.5, 0.25, 2.0), colours="bgr")
    image = np.empty((240, 320, 3), np.uint8)
    image[:] = (255, 51, 0)  # R, G, B
    values = tensor(image, card, place(card, 320, 240))[0, :, 5, 5]
    assert values == pytest.approx([(0.0 - 0.1) / 0.5, (0.2 - 0.2) / 0.25, (1.0 - 0.3) / 2.0], abs=1e-6)


def test_texture_too_fine_for_the_network_is_averaged():
    """Sampled here and there, a fine grid would become broad stripes that are not in the image."""
    image = np.zeros((480, 640, 3), np.uint8)
    image[:, ::5] = 255
    card = replace(CARD, input_width=128, input_height=96, mean=(0.0,) * 3, std=(1.0,) * 3)
    values = tensor(image, card, place(card, 640, 480))
    assert values == pytest.approx(np.full_like(values, 0.2), abs=1e-4)


@pytest.mark.parametrize(("width", "height"), [(128, 500), (700, 96)])
def test_a_side_that_shrinks_is_averaged_though_the_other_grows(width, height):
    """KITTI's 376 rows become 378 while its 1241 columns become 504."""
    image = np.zeros((480, 640, 3), np.uint8)
    if width < 640:
        image[:, ::2] = 255
    else:
        image[::2] = 255
    card = replace(CARD, input_width=width, input_height=height, mean=(0.0,) * 3, std=(1.0,) * 3)
    values = tensor(image, card, place(card, 640, 480))
    assert values.shape == (1, 3, height, width)
    assert values == pytest.approx(np.full_like(values, 0.5), abs=0.11)


def pale(low: float, high: float) -> np.ndarray:
    """A picture whose darkest and brightest tenths are those; all between comes as often."""
    shares = np.clip(np.linspace(-0.125, 1.125, 320), 0.0, 1.0)
    grey = np.round(low + (high - low) * np.tile(shares, (240, 1))).astype(np.uint8)
    return np.dstack([grey, grey // 2, grey])


@pytest.mark.parametrize(
    ("low", "high", "shown"),
    [
        (0, 255, (0, 255)),
        (60, 190, (60, 190)),
        (0, 128, (0, 128)),
        (0, 32, (0, 128)),  # dark
        (10, 40, (0, 128)),
        (225, 255, (127, 255)),  # too bright
        (100, 150, (61, 189)),  # hazy
        (64, 191, (63.5, 191.5)),  # hardly: as good as it is
        (7, 7, (7, 7)),  # nothing in it
        (100, 104, (70, 134)),  # hardly more than noise: sixteen times at most
    ],
)
def test_dark_and_pale_pictures_are_spread_to_half_of_the_range_and_others_left(low, high, shown):
    card = replace(CARD, levels=SPREAD, mean=(0.0,) * 3, std=(1.0,) * 3)
    values = 255.0 * tensor(pale(low, high), card, place(card, 320, 240))[0]
    assert (values[0].min(), values[0].max()) == pytest.approx(shown, abs=0.6)
    assert 0.0 <= values.min() <= values.max() <= 255.0


def test_in_the_dark_all_colours_get_as_many_times_their_light():
    image, card = pale(0, 40), replace(CARD, levels=SPREAD, mean=(0.0,) * 3, std=(1.0,) * 3)
    values = 255.0 * tensor(image, card, place(card, 320, 240))[0]
    assert values[1].max() == pytest.approx(64.0, abs=0.1)
    spread, shift = levels(image)
    assert spread == pytest.approx(3.2)
    assert shift == pytest.approx(np.zeros(3))
    kept = 255.0 * tensor(image, replace(card, levels=KEPT), place(card, 320, 240))[0]
    assert kept[1].max() == pytest.approx(20.0, abs=0.1)


@pytest.mark.parametrize("haze", [(170, 140, 90), (20, 110, 120), (200, 200, 10)])
def test_haze_has_a_colour_and_takes_none_away(haze: tuple[int, int, int]):
    """Were all moved as the brightest is, blue would be black throughout in a warm haze."""
    rng = np.random.default_rng(5)
    room = cv2.GaussianBlur(rng.uniform(0, 255, (240, 320, 3)).astype(np.float32), (0, 0), 4)
    room = 255 * (room - room.min()) / (room.max() - room.min())
    card = replace(CARD, levels=SPREAD, mean=(0.0,) * 3, std=(1.0,) * 3)
    shown = 255.0 * tensor(np.round(0.15 * room + haze).astype(np.uint8), card, place(card, 320, 240))[0]
    for colour in range(3):
        assert np.corrcoef(shown[colour].ravel(), room[:, :, colour].ravel())[0, 1] > 0.99
        assert np.mean(shown[colour] <= 0.0) < 0.02
        assert np.mean(shown[colour] >= 255.0) < 0.02


def test_the_network_sees_as_good_as_the_same_of_a_room_in_any_light_and_haze():
    rng = np.random.default_rng(3)
    room = cv2.GaussianBlur(rng.uniform(0, 255, (240, 320, 3)).astype(np.float32), (0, 0), 4)
    room = 20 + 200 * (room - room.min()) / (room.max() - room.min())
    card = replace(CARD, levels=SPREAD, mean=(0.0,) * 3, std=(1.0,) * 3)
    placement = place(card, 320, 240)
    whole = tensor(np.round(room).astype(np.uint8), card, placement).ravel()
    for dim in (0.2 * room, 0.05 * room, 0.15 * room + 100):
        seen = tensor(np.round(dim).astype(np.uint8), card, placement).ravel()
        assert np.corrcoef(whole, seen)[0, 1] > 0.9  # eleven grey levels, at the darkest
        assert np.ptp(np.quantile(seen, [0.01, 0.99])) > 0.35


@pytest.mark.parametrize("kept", [0.011, 0.05])
def test_a_dark_picture_with_lamps_in_it_is_taken_as_it_is(kept: float):
    """One pixel in ninety is bright: exposure has been set for those."""
    image = np.full((240, 320, 3), 20, np.uint8)
    image[: math.ceil(kept * 240)] = 240
    assert levels(image) is None
