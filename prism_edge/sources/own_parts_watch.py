"""Says where a camera has its own robot in view, or writing in its images, that nobody has masked (pure)."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from prism_edge.sources.mask import Shown
from prism_edge.sources.own_parts import OwnParts

IMAGES = 40  # of a moving camera, for one judgement
WORTH_SAYING = 0.01  # of the image


class OwnPartsWatch:
    """Looks at released images, three a second at most, and judges every IMAGES of them anew."""

    def __init__(self, shown: Shown | None = None) -> None:
        """``shown`` (height, width) is the mask that is in use, if any."""
        self._shown = shown
        self._parts = OwnParts()
        self.warning = ""

    def look(self, pixels: NDArray[np.uint8], stamp_ns: int) -> None:
        """An image, grey (h, w) or BGR (h, w, 3)."""
        if not self._parts.look(pixels, stamp_ns) or self._parts.taken < IMAGES:
            return
        own = self._parts.found()
        self._parts.clear()
        if self._shown is not None:
            shown = cv2.resize(self._shown.astype(np.uint8), own.shape[::-1], interpolation=cv2.INTER_NEAREST)
            own &= shown.astype(bool)
        share = float(own.mean())
        self.warning = (
            f"{100.0 * share:.0f} % of the image stay as they are while the rest moves: "
            "if that is the robot itself, mask it (source.mask)"
            if share > WORTH_SAYING
            else ""
        )
