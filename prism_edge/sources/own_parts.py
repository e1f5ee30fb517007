"""What of a moving camera's images never moves: its robot's own parts, or writing laid over them (pure)."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from prism_edge.messages import F32

WIDTH = 320  # pixels across, of what is compared: in smaller images, what is far ahead stands still
APART_NS = 300_000_000  # between two images that are compared
MOVED = 4.0  # grey levels: a pixel whose fine texture changes by more has moved
MOVED_SHARE = 0.25  # of the pixels: an image with fewer is of a camera that stands, and tells nothing
FINE = 17  # pixels of the small image: texture coarser than that is light and shade
AROUND = 9  # pixels over which energies are summed
TEXTURE = 2.5  # grey levels: what has less offers no corners
STAYS = 0.8  # of the texture's energy; images without own parts have 0.6 at most, own parts nearly all
SMALLEST, LARGEST_HOLE = 0.002, 0.01  # of the image
GAP = 15  # pixels of the small image, between corners of one thing
MARGIN = 3
MOST = 0.6  # of the image: beyond it the camera stood, and something moved before it


class OwnParts:
    """Adds up images of one size while the camera moves; what stayed in all of them is its robot's own."""

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """Begin anew."""
        self.taken, self.undecided = 0, False
        self._last_ns: int | None = None
        self._last: F32 | None = None
        self._sum = self._squares = np.zeros((0, 0), np.float32)

    def look(self, pixels: NDArray[np.uint8], stamp_ns: int) -> bool:
        """Take an image, grey (h, w) or BGR (h, w, 3), unless it says nothing new; whether it was taken."""
        if self._last_ns is not None and 0 <= stamp_ns - self._last_ns < APART_NS:
            return False
        self._last_ns = stamp_ns
        texture = _fine_texture(pixels)
        if self._last is not None:
            if texture.shape != self._last.shape:
                self.clear()
            elif np.mean(np.abs(texture - self._last) > MOVED) < MOVED_SHARE:
                return False
        if self._last is None:
            self._sum, self._squares = np.zeros_like(texture), np.zeros_like(texture)
        self._last = texture
        self._sum += texture
        self._squares += texture * texture
        self.taken += 1
        return True

    def stays(self) -> tuple[F32, NDArray[np.bool_]]:
        """Of each pixel of the small image: the share of its texture that stays, and whether it has any."""
        count = np.float32(max(self.taken, 1))
        fixed = _around((self._sum / count) ** 2)
        all_of_it = _around(self._squares / count)
        textured = all_of_it > TEXTURE**2
        return np.asarray(fixed / np.maximum(all_of_it, 1e-6), np.float32), textured

    def found(self) -> NDArray[np.bool_]:
        """Where the robot's own parts are in the small image; nowhere before two images were taken.

        Nowhere, too, and ``undecided``, where more than MOST of the image stays as it is.
        """
        if self.taken < 2:
            return np.zeros(self._sum.shape, bool)
        share, textured = self.stays()
        own = (textured & (share > STAYS)).astype(np.uint8)
        own = cv2.morphologyEx(own, cv2.MORPH_CLOSE, np.ones((GAP, GAP), np.uint8))
        kept = _larger(own, SMALLEST)
        filled = (1 - _larger(1 - kept, LARGEST_HOLE)).astype(np.uint8)
        own = cv2.dilate(filled, np.ones((2 * MARGIN + 1, 2 * MARGIN + 1), np.uint8))
        self.undecided = bool(own.mean() > MOST)
        return np.zeros(own.shape, bool) if self.undecided else np.asarray(own, bool)


def _fine_texture(pixels: NDArray[np.uint8]) -> F32:
    grey = pixels if pixels.ndim == 2 else cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY)
    height, full = grey.shape
    if full > WIDTH:
        size = (WIDTH, max(round(height * WIDTH / full), 1))
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    small = grey.astype(np.float32)
    return np.asarray(small - cv2.boxFilter(small, -1, (FINE, FINE)), np.float32)


def _larger(where: NDArray[np.uint8], share: float) -> NDArray[np.uint8]:
    """Those connected pieces of what is 1 that cover at least ``share`` of the image."""
    _, labels, statistics, _ = cv2.connectedComponentsWithStats(where)
    large = statistics[:, cv2.CC_STAT_AREA] >= share * where.size
    large[0] = False  # what is 0
    return np.asarray(large[labels], np.uint8)


def _around(energy: F32) -> F32:
    return np.asarray(cv2.boxFilter(energy, -1, (AROUND, AROUND)), np.float32)
