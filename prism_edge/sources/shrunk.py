"""A camera whose images are larger than can be tracked at its rate: each is made smaller as it comes."""

from __future__ import annotations

import cv2
import numpy as np

from prism_edge.geometry.cameras import Camera
from prism_edge.messages import U8
from prism_edge.sources.base import Absent, Image, Source, Unreadable
from prism_edge.sources.checks import UNCALIBRATED
from prism_edge.sources.wrapped import Wrapped


class Shrunk(Wrapped):
    """Another source with images, and a camera, smaller by a whole number each way."""

    def __init__(self, source: Source, factor: int) -> None:
        super().__init__(source)
        self.camera, self._factor = UNCALIBRATED, factor
        self._learn()

    def open(self) -> None:
        self._source.open()
        self._learn()

    def _learn(self) -> None:
        """A video knows these once it is open, a camera with a calibration of its own once it is there."""
        self.name = f"{self._source.name}, 1/{self._factor} of its size"
        self.period_ns, self.frame_count = self._source.period_ns, self._source.frame_count
        self._whole: tuple[int, int] | None = None  # width and height as they come; None: not known yet
        self._misfit = ""  # how the newest image's size is another
        whole = self._source.camera
        if whole is not UNCALIBRATED:
            self._whole = whole.width, whole.height
            self.camera = shrunk_camera(whole, self._factor)

    def read(self) -> Image | Unreadable | Absent | None:
        item = self._source.read()
        if not isinstance(item, Image):
            return item
        size = item.pixels.shape[1], item.pixels.shape[0]
        self._whole = self._whole or size
        # One of nearly that size would be as large as the others afterwards, and not theirs.
        self._misfit = "" if size == self._whole else "{}x{} instead of {}x{}".format(*size, *self._whole)
        if self._misfit:
            return Unreadable(item.index, item.stamp_ns, f"image {item.index} is {self._misfit}")
        pixels = shrunk(item.pixels, self._factor)
        return Image(item.index, item.stamp_ns, pixels, item.captured_monotonic_ns)

    def health(self) -> dict[str, str]:
        """The source's own, which can't know of an estimated camera how large its images are to be."""
        values = self._source.health()
        unsaid = self.live and self._misfit and "warning" not in values
        return values | ({"warning": f"the camera sends {self._misfit}"} if unsaid else {})


def shrunk(pixels: U8, factor: int) -> U8:
    """An image (h, w) or (h, w, 3), smaller by ``factor``: each pixel the mean of those in its place."""
    size = _size(pixels.shape[1], pixels.shape[0], factor)
    return np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), np.uint8)


def shrunk_camera(camera: Camera, factor: int) -> Camera:
    """The camera of :func:`shrunk` images, exact also where ``factor`` does not divide their size."""
    return camera.resized(*_size(camera.width, camera.height, factor))


def _size(width: int, height: int, factor: int) -> tuple[int, int]:
    return max(width // factor, 1), max(height // factor, 1)
