"""From the camera image to the network's input and back to pixels of its depth map."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from prism_edge.depth.contract import CROP, SPREAD, ModelCard
from prism_edge.geometry.cameras import Camera

# A picture in which less than half of the range lies between its darkest and its brightest hundredth is
# spread to that: networks have hardly seen such, and take what they see in them for nearer, the paler it is.
HUNDREDTH, CONTRAST = 0.01, 128.0
LEAST = 8.0  # of the range: with less there is hardly more in a picture than noise
LOOKS = 120  # pixels along the shorter side that are looked at: enough to tell how pale a picture is


@dataclass(frozen=True)
class Placement:
    """Image resized to (resized_width, resized_height), then cut to the input at (left, top).

    Pixel centres are at whole numbers, and resizing is about the image's outer corner: image pixel x
    lies at (x + 0.5) * scale_x - 0.5 - left of the input.
    """

    scale_x: float  # input pixels an image pixel
    scale_y: float
    left: int  # input pixels cut off
    top: int
    resized_width: int
    resized_height: int
    input_width: int
    input_height: int

    def focal_length(self, camera: Camera) -> float:
        """Geometric mean of the focal lengths in pixels of the network's input."""
        return math.sqrt(camera.fx * self.scale_x * camera.fy * self.scale_y)

    def to_input(self, camera: Camera) -> NDArray[np.float64]:
        """(4,) fx, fy, cx, cy of a camera in pixels of the network's input; its distortion is left out."""
        return np.array(
            [
                camera.fx * self.scale_x,
                camera.fy * self.scale_y,
                (camera.cx + 0.5) * self.scale_x - 0.5 - self.left,
                (camera.cy + 0.5) * self.scale_y - 0.5 - self.top,
            ]
        )

    def to_image(self, fx: float, fy: float, cx: float, cy: float) -> NDArray[np.float64]:
        """(4,) of a camera given in pixels of the network's input: the same in pixels of the image."""
        return np.array(
            [
                fx / self.scale_x,
                fy / self.scale_y,
                (cx + self.left + 0.5) / self.scale_x - 0.5,
                (cy + self.top + 0.5) / self.scale_y - 0.5,
            ]
        )

    def image_to_depth(self, width: int, height: int) -> NDArray[np.float64]:
        """(4,) a, b, c, d: image pixel (x, y) is at (a x + b, c y + d) of a width x height depth map."""
        out = []
        for scale, cut, size, extent in (
            (self.scale_x, self.left, width, self.input_width),
            (self.scale_y, self.top, height, self.input_height),
        ):
            shrink = size / extent
            out += [scale * shrink, (0.5 * scale - cut) * shrink - 0.5]
        return np.array(out)


def place(card: ModelCard, width: int, height: int) -> Placement:
    """How an image of width x height comes into the network's input (the card's ``resize``)."""
    w, h = card.input_width, card.input_height
    resized = (w, h)
    if card.resize == CROP:
        scale = max(w / width, h / height)
        resized = (max(w, round(width * scale)), max(h, round(height * scale)))
    left, top = (resized[0] - w) // 2, (resized[1] - h) // 2
    return Placement(resized[0] / width, resized[1] / height, left, top, *resized, w, h)


def tensor(rgb: NDArray[np.uint8], card: ModelCard, placement: Placement) -> NDArray[np.float32]:
    """The network's input (1, 3, h, w) float32 of an image (height, width, 3) uint8 RGB."""
    size = (placement.resized_width, placement.resized_height)
    # Averaging a side that shrinks keeps fine texture from turning into false structure; in floating point,
    # as OpenCV's 8-bit blending loses 0.2 % of the brightness.
    shrunk = (min(size[0], rgb.shape[1]), min(size[1], rgb.shape[0]))
    image = cv2.resize(rgb.astype(np.float32), shrunk, interpolation=cv2.INTER_AREA)
    if shrunk != size:
        image = cv2.resize(image, size, interpolation=cv2.INTER_LINEAR)
    rows = slice(placement.top, placement.top + placement.input_height)
    image = image[rows, placement.left : placement.left + placement.input_width]
    if card.levels == SPREAD and (found := levels(rgb)) is not None:
        spread, shift = found
        image = np.clip(np.float32(spread) * image + shift, 0.0, 255.0)
    if card.colours == "bgr":
        image = image[:, :, ::-1]
    gain = (card.pixel_scale / np.array(card.std)).astype(np.float32)
    offset = (np.array(card.mean) / np.array(card.std)).astype(np.float32)
    values = np.ascontiguousarray(image.transpose(2, 0, 1)) * gain[:, None, None] - offset[:, None, None]
    return np.ascontiguousarray(values[None], dtype=np.float32)


def levels(rgb: NDArray[np.uint8]) -> tuple[float, NDArray[np.float32]] | None:
    """By what a dark or pale image (h, w, 3) is to be multiplied, and what each colour (3,) gets then.

    None for one that is neither. Each colour is spread about its own middle, as haze has one, and moved where
    that would leave the range; so nothing jumps where a picture is just pale enough.
    """
    every = max(1, min(rgb.shape[:2]) // LOOKS)
    colours = rgb[::every, ::every].reshape(-1, 3)
    most = len(colours) - 1
    ranks = round(HUNDREDTH * most), round((1.0 - HUNDREDTH) * most)
    low, high = np.partition(colours, ranks, axis=0)[list(ranks)].astype(np.float32)
    widest = float((high - low).max())
    if widest >= CONTRAST:
        return None
    spread = CONTRAST / max(widest, LEAST)
    span = spread * (high - low)
    darkest = np.clip((low + high - span) / 2.0, 0.0, 255.0 - span)
    return spread, (darkest - spread * low).astype(np.float32)
