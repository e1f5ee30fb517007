"""A keyframe's picture and its depth, pixel for pixel, as a lens without distortion would have them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from prism_edge.depth.prediction import OPEN, PROBABILITY, in_its_range
from prism_edge.geometry.cameras import Camera
from prism_edge.geometry.field_of_view import in_image
from prism_edge.geometry.poses import Array
from prism_edge.messages import F32, U8
from prism_edge.reconstruction.viewpoints import Viewpoint
from prism_edge.scale.gate import DepthView, image_pixels, is_open_ended

WIDEST = 1.5  # of a ray on the plane z = 1: 56 degrees off the axis
_RIM = 65  # points of each side of an image
_WHOLE = 0.99  # of a pixel must have depth where four are blended


@dataclass(frozen=True)
class Look:
    """``view`` has the depth (h, w) in metres, 0 for none, of every pixel of ``grey`` and ``colours``."""

    view: DepthView
    grey: U8  # (h, w)
    colours: U8  # (h, w, 3) RGB

    def with_depth(self, depth: F32) -> Look:
        """The same, at another depth (h, w)."""
        return replace(self, view=replace(self.view, depth=depth))


def look(
    viewpoint: Viewpoint,
    rgb: U8,
    depth: F32,
    confidence: F32,
    image_to_depth: Array,
    width: int,
    shown: NDArray[np.bool_] | None = None,
) -> Look:
    """Lay picture (height, width, 3), depth and confidence (h, w) of a keyframe out at ``width`` pixels.

    A lens that bends the picture inwards sees more than that holds: it is made larger (:func:`_held`).
    ``confidence`` is (0, 0) where there is none; ``image_to_depth`` (4,) is of raw pixels. A picture that is
    narrower stays as it is. Where ``shown`` (height, width) is False, and beside it, there is no depth.
    """
    taken = viewpoint.camera
    scaled = _scaled(taken, width)
    small = _held(taken, scaled)
    x, y = np.meshgrid(np.arange(small.width, dtype=np.float64), np.arange(small.height, dtype=np.float64))
    across, down = scaled.width / taken.width, scaled.height / taken.height
    ideal = taken.to_pixels(small.on_plane(np.column_stack([x.ravel(), y.ravel()])))
    raw = taken.distort_pixels(ideal)
    colours = cv2.resize(rgb, (scaled.width, scaled.height), interpolation=cv2.INTER_AREA)
    if not taken.is_ideal:
        places = _places((raw + 0.5) * (across, down) - 0.5, small)
        colours = cv2.remap(colours, *places, cv2.INTER_LINEAR)
    a, b, c, d = image_to_depth
    at = raw * (a, c) + (b, d)
    there = between_four(depth, *_places(at, small))
    if not taken.is_ideal:  # from far outside a lens that folds over leads back into its image
        there = np.where(in_image(taken, ideal).reshape(there.shape), there, np.float32(0))
    if shown is not None:  # a network's pixel may be wider than what is hidden
        world = cv2.remap(shown.astype(np.float32), *_places(raw, small), cv2.INTER_LINEAR)
        there = np.where(world > _WHOLE, there, np.float32(0))
    view = DepthView(
        viewpoint.keyframe,
        viewpoint.map_from_camera,
        small,
        there,
        np.array([1.0, 0.0, 1.0, 0.0]),
        _resampled(_settled(confidence), *_places(at, small)) if confidence.size else confidence,
        1.0,
    )
    return Look(view, cv2.cvtColor(colours, cv2.COLOR_RGB2GRAY), np.ascontiguousarray(colours))


def surface(view: DepthView) -> Array:
    """Where (h, w, 3) each pixel's surface is, in the camera's frame; the camera's centre without depth."""
    height, width = view.depth.shape
    rays = view.camera.normalise(image_pixels(view)).reshape(height, width, 2)
    z = view.depth.astype(np.float64) * view.units_per_metre
    return np.dstack([rays * z[..., None], z])


def between_four(depth: F32, x: F32, y: F32) -> F32:
    """Depth at places x, y (h, w) of a depth map; 0 unless all four pixels round one have depth."""
    there = cv2.remap((depth > 0).astype(np.float32), x, y, cv2.INTER_LINEAR)
    blended = cv2.remap(np.where(depth > 0, depth, np.float32(0)), x, y, cv2.INTER_LINEAR)
    whole = there > _WHOLE
    return np.where(whole, blended / np.where(whole, there, np.float32(1)), np.float32(0))


def _settled(confidence: F32) -> F32:
    """Confidence in the range of the kind that the whole of it shows: blended pixels may show another."""
    positive = confidence[confidence > 0]
    is_open = bool(positive.size) and is_open_ended(positive)
    return in_its_range(confidence, OPEN if is_open else PROBABILITY)


def _resampled(confidence: F32, x: F32, y: F32) -> F32:
    return np.asarray(
        cv2.remap(confidence, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.float32
    )


def _scaled(taken: Camera, width: int) -> Camera:
    """The ideal camera of a picture of that width."""
    scale = min(1.0, width / taken.width)
    return taken.ideal().resized(max(1, round(taken.width * scale)), max(1, round(taken.height * scale)))


def _held(taken: Camera, scaled: Camera) -> Camera:
    """The ideal camera, of the focal length of ``scaled``, whose picture holds all that ``taken`` sees.

    But no ray beyond WIDEST, where an ideal picture runs away, and at most twice the sides.
    """
    if taken.is_ideal:
        return scaled
    x, y = (np.linspace(-0.5, side - 0.5, _RIM) for side in (taken.width, taken.height))
    sides = [np.column_stack([x, np.full(_RIM, at)]) for at in (y[0], y[-1])]
    sides += [np.column_stack([np.full(_RIM, at), y]) for at in (x[0], x[-1])]
    rim = taken.normalise(np.concatenate(sides))
    rim *= np.minimum(1.0, WIDEST / np.maximum(np.hypot(*rim.T), 1e-9))[:, None]
    size = np.array([scaled.width, scaled.height])
    reach = scaled.to_pixels(rim[np.isfinite(rim).all(axis=1)])
    before = np.clip(np.ceil(-0.5 - reach.min(axis=0, initial=0.0)), 0, size // 2).astype(int)
    after = np.clip(np.ceil(reach.max(axis=0, initial=0.0) + 0.5 - size), 0, size // 2).astype(int)
    width, height = (size + before + after).tolist()
    cx, cy = scaled.cx + before[0], scaled.cy + before[1]
    return replace(scaled, width=width, height=height, cx=cx, cy=cy)


def _places(pixels: Array, camera: Camera) -> tuple[F32, F32]:
    """x and y (h, w) of pixels (h w, 2), one for each of a picture of ``camera``."""
    x, y = pixels.astype(np.float32).T.reshape(2, camera.height, camera.width)
    return x, y
