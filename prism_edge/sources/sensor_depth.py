"""Depth images that an RGB-D dataset carries, in metres."""

from __future__ import annotations

import logging
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from prism_edge.errors import SourceError
from prism_edge.geometry.cameras import Camera
from prism_edge.messages import F32
from prism_edge.sources.image_file import read_as_stored
from prism_edge.sources.known_cameras import SEVEN_SCENES, seven_scenes
from prism_edge.sources.listing import Listing
from prism_edge.sources.open import find_listing
from prism_edge.sources.tum import read_list

# Raw values of one metre.
_TUM_UNITS, _SEVEN_SCENES_UNITS = 5000.0, 1000.0
_NO_RETURN = 65535  # 7-Scenes' other mark of an invalid pixel, beside 0
_TUM_PAIRING_NS = 20_000_000
# 7-Scenes' depth camera: intrinsics as published, of an image 640 wide; where the colour camera is in its
# frame (m), found by laying depth edges over edges of redkitchen's images (docs/SOURCES.md).
DEPTH_CAMERA = (585.0, 585.0, 320.0, 240.0)
COLOUR_IN_DEPTH = np.array([0.025, 0.005, 0.0])


log = logging.getLogger("prism_edge.sources")


class SensorDepth:
    """Depth of each colour image of a TUM RGB-D (BONN) or 7-Scenes folder.

    The pixels are the depth camera's: registered to colour in TUM and BONN folders, not in 7-Scenes ones.
    Other recorders name their files as 7-Scenes does: where no folder's name speaks for it, and the camera
    isn't its own, depth is taken as registered, which is said once. Raises SourceError where the folder
    holds no depth.
    """

    def __init__(self, folder: Path) -> None:
        listing = find_listing(folder)
        self._units = _TUM_UNITS
        self._said = False
        self._alike = listing.layout == "7-Scenes"
        self._apart = self._alike and seven_scenes(folder) is SEVEN_SCENES
        if listing.layout == "TUM RGB-D" and (folder / "depth.txt").is_file():
            self._files = _nearest(listing, folder)
        elif listing.layout == "7-Scenes":
            self._units = _SEVEN_SCENES_UNITS
            names = (path.with_name(path.name.split(".")[0] + ".depth.png") for path in listing.files)
            self._files = [path if path.is_file() else None for path in names]
        else:
            self._files = []
        if not any(self._files):
            raise SourceError(f"{folder} ({listing.layout}) holds no depth images")

    def __len__(self) -> int:
        """How many colour images there are."""
        return len(self._files)

    def in_colour(self, index: int, camera: Camera) -> F32 | None:
        """As :meth:`read`, but of the pixels of ``camera``, the colour camera, whatever the image's size."""
        depth, apart = self.read(index), self.is_apart(camera)
        if self._alike and not (apart or self._said):
            self._said = True
            log.warning("depth is taken as registered to colour: no folder is called as 7-Scenes' are")
        return seen_by_colour(depth, camera) if depth is not None and apart else depth

    def is_apart(self, camera: Camera) -> bool:
        """Whether the images are of 7-Scenes' depth camera, and ``camera`` the colour camera beside it."""
        return self._apart or (self._alike and np.allclose(_pinhole(camera), _pinhole(SEVEN_SCENES[1])))

    def file(self, index: int) -> Path | None:
        """The depth image of colour image ``index``; None where there is none within 20 ms."""
        return self._files[index] if 0 <= index < len(self._files) else None

    def read(self, index: int) -> F32 | None:
        """Depth (h, w) in metres along z, 0 for none, of colour image ``index``.

        None where that image has no depth within 20 ms, or where its file can't be read.
        """
        path = self.file(index)
        raw = None if path is None else read_as_stored(path, cv2.IMREAD_UNCHANGED)
        if raw is None or raw.dtype != np.uint16 or raw.ndim != 2:
            return None
        raw[raw == _NO_RETURN] = 0
        return raw.astype(np.float32) / np.float32(self._units)


def _pinhole(camera: Camera) -> tuple[float, ...]:
    """In shares of the image, of whatever size that is."""
    across, down = camera.width, camera.height
    return camera.fx / across, camera.fy / down, (camera.cx + 0.5) / across, (camera.cy + 0.5) / down


def image_to_depth(depth: F32, camera: Camera) -> NDArray[np.float64]:
    """(4,) a, b, c, d: pixel (x, y) of ``camera``'s image is at (a x + b, c y + d) of its depth."""
    across, down = depth.shape[1] / camera.width, depth.shape[0] / camera.height
    return np.array([across, 0.5 * across - 0.5, down, 0.5 * down - 0.5])


def seen_by_colour(depth: F32, camera: Camera) -> F32:
    """Depth (h, w) of 7-Scenes' depth camera as its colour camera sees it, of the same shape; 0 for none.

    Each pixel goes where its point is seen from there; the nearest of those that meet counts.
    """
    height, width = depth.shape
    row, column = np.nonzero(depth)
    z = depth[row, column].astype(np.float64)
    fx, fy, cx, cy = DEPTH_CAMERA
    step = 640.0 / width
    x = ((column + 0.5) * step - 0.5 - cx) / fx * z
    y = ((row + 0.5) * step - 0.5 - cy) / fy * z
    points = np.column_stack([x, y, z]) - COLOUR_IN_DEPTH
    pixels = (camera.project(points) + 0.5) * (width / camera.width, height / camera.height) - 0.5
    at = np.rint(pixels).astype(np.int64)
    inside = np.all((at >= 0) & (at < (width, height)), axis=1)
    seen = np.full(depth.shape, np.inf, np.float32)
    np.minimum.at(seen, (at[inside, 1], at[inside, 0]), points[inside, 2].astype(np.float32))
    seen[np.isinf(seen)] = 0.0
    return seen


def _nearest(listing: Listing, folder: Path) -> list[Path | None]:
    """The depth image nearest in time to each colour image."""
    stamps, files = read_list(folder, "depth.txt")
    if not files:
        return []
    order = np.argsort(np.array(stamps, dtype=np.int64), kind="stable")
    ordered = np.array(stamps, dtype=np.int64)[order]
    chosen: list[Path | None] = []
    for stamp in listing.stamps_ns:
        right = int(np.clip(np.searchsorted(ordered, stamp), 0, len(ordered) - 1))
        best = min((max(right - 1, 0), right), key=lambda i: abs(int(ordered[i]) - stamp))
        chosen.append(files[order[best]] if abs(int(ordered[best]) - stamp) <= _TUM_PAIRING_NS else None)
    return chosen
