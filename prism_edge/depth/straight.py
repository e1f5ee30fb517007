"""Pictures of strongly bent lenses set straight for a network, and its depths carried back.

A network has learnt from pictures of ordinary lenses. One that sees a wide lens's image as it was taken takes
the border, which is squeezed together, for farther away than it is, and all for farther in proportion.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from prism_edge.depth.prediction import Prediction
from prism_edge.depth.shown_otherwise import ShownOtherwise
from prism_edge.errors import ModelError
from prism_edge.geometry.cameras import Camera
from prism_edge.geometry.field_of_view import inner_box
from prism_edge.geometry.poses import Array
from prism_edge.messages import F32

if TYPE_CHECKING:
    from prism_edge.depth import DepthNetwork

WIDEST_DEG = 40.0  # off the axis, across and up: networks have hardly learnt from wider pictures
BENT = 0.1  # of half the diagonal, by which a pixel is moved: TUM's lenses move none by more than 0.06
STRAIGHT = "+straight"  # ends the identity of a network that is shown such
_GRID = 33  # places along each side that are looked at


class StraightNetwork(ShownOtherwise):
    """A network that is shown straight pictures of one camera, and whose depths are of the bent ones."""

    def __init__(self, network: DepthNetwork, straight: Camera) -> None:
        super().__init__(network, STRAIGHT)
        self._straight = straight

    def infer(self, rgb: NDArray[np.uint8], camera: Camera) -> Prediction:
        """Metric depth of an image (height, width, 3) uint8 RGB that ``camera`` took, by its own pixels."""
        answer = self._network.infer(set_straight(rgb, camera, self._straight), self._straight)
        return bent_back(answer, camera, self._straight)


def as_shown(network: DepthNetwork, camera: Camera) -> DepthNetwork:
    """The network as it is shown what ``camera`` takes: itself, but where the lens bends strongly."""
    straight = straight_camera(camera)
    return network if straight == camera else StraightNetwork(network, straight)


@lru_cache(maxsize=64)
@np.errstate(all="ignore")  # a lens that means nothing goes anywhere
def straight_camera(camera: Camera) -> Camera:
    """The ideal camera of a picture set straight; the camera as it is where its own are straight enough.

    Its picture is as wide as the camera's and shows no more than that, so no part of it is empty, and nothing
    beyond WIDEST_DEG.
    """
    if camera.is_ideal or not _is_bent(camera):
        return camera
    reach = math.tan(math.radians(WIDEST_DEG))
    left, right, top, bottom = inner_box(camera)
    left, right = max(left, camera.cx - reach * camera.fx), min(right, camera.cx + reach * camera.fx)
    top, bottom = max(top, camera.cy - reach * camera.fy), min(bottom, camera.cy + reach * camera.fy)
    if not (left < camera.cx < right and top < camera.cy < bottom):  # the lens folds over, or is far aside
        return camera
    scale = camera.width / (right - left)
    return Camera(
        camera.width,
        max(round(scale * (bottom - top)), 1),
        scale * camera.fx,
        scale * camera.fy,
        scale * (camera.cx - left) - 0.5,
        scale * (camera.cy - top) - 0.5,
    )


def set_straight(rgb: NDArray[np.uint8], camera: Camera, straight: Camera) -> NDArray[np.uint8]:
    """What ``straight`` would have seen of the picture (height, width, 3) that ``camera`` took.

    Raises ModelError where that is of another size.
    """
    if rgb.shape != (camera.height, camera.width, 3):
        raise ModelError(f"image {rgb.shape} is not of its camera ({camera.height}, {camera.width}, 3)")
    if straight == camera:
        return rgb
    places, border = _raw_places(camera, straight), cv2.BORDER_REPLICATE  # half a pixel of it at most
    return np.asarray(cv2.remap(rgb, *places, cv2.INTER_LINEAR, None, border), np.uint8)


def bent_back(prediction: Prediction, camera: Camera, straight: Camera) -> Prediction:
    """What a network said of the straight picture, of ``camera``'s own pixels: the nearest pixel's.

    As large as it was, and of all of the image; what the straight picture doesn't show has no depth, and no
    confidence (NaN: a probability of 0 is one).
    """
    if straight == camera:
        return prediction
    height, width = prediction.depth.shape
    to_depth = tuple(prediction.image_to_depth.tolist())
    places = _depth_places(camera, straight, (width, height), to_depth)
    across, down = width / camera.width, height / camera.height

    def carried(plane: F32, beside: float) -> F32:
        if not plane.size:
            return plane
        border = cv2.BORDER_CONSTANT
        return np.asarray(cv2.remap(plane, *places, cv2.INTER_NEAREST, None, border, beside), np.float32)

    return replace(
        prediction,
        depth=carried(prediction.depth, 0.0),
        confidence=carried(prediction.confidence, np.nan),
        image_to_depth=np.array([across, 0.5 * across - 0.5, down, 0.5 * down - 0.5]),
    )


def _is_bent(camera: Camera) -> bool:
    x, y = (np.linspace(0.0, side - 1.0, _GRID) for side in (camera.width, camera.height))
    raw = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    moved = np.linalg.norm(camera.undistort_pixels(raw) - raw, axis=1)
    return bool(moved.max() > BENT * math.hypot(camera.width, camera.height) / 2.0)


@lru_cache(maxsize=4)
def _raw_places(camera: Camera, straight: Camera) -> tuple[F32, F32]:
    """Columns and rows (h, w) of the camera's image that the straight picture's pixels show."""
    ideal = camera.to_pixels(straight.on_plane(_pixels(straight.width, straight.height)))
    return _planes(camera.distort_pixels(ideal), straight.width, straight.height)


@lru_cache(maxsize=4)
def _depth_places(
    camera: Camera, straight: Camera, size: tuple[int, int], to_depth: tuple[float, ...]
) -> tuple[F32, F32]:
    """Columns and rows (h, w) of a straight picture's depth that belong to depth of the camera's own image.

    Both depth maps are of ``size``, width and height; ``to_depth`` is the straight one's image_to_depth.
    """
    shrink = np.array(size) / (camera.width, camera.height)
    raw = (_pixels(*size) + 0.5) / shrink - 0.5
    at = straight.to_pixels(camera.on_plane(camera.undistort_pixels(raw)))
    a, b, c, d = to_depth
    return _planes(at * (a, c) + (b, d), *size)


def _pixels(width: int, height: int) -> Array:
    x, y = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
    return np.column_stack([x.ravel(), y.ravel()])


def _planes(places: Array, width: int, height: int) -> tuple[F32, F32]:
    x, y = places.T.reshape(2, height, width).astype(np.float32)
    return x, y
