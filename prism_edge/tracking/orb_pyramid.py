"""OpenCV's ORB, level by level: what it finds over all levels, with the image scaled only once.

cv2.ORB scales the image to detect and scales it again to describe.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain
from operator import attrgetter
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from prism_edge.geometry.poses import Array
from prism_edge.tracking.point_table import Index

Grey: TypeAlias = NDArray[np.uint8]

PATCH = 31  # pixels of a level that a descriptor looks at
BORDER = 19  # what a keypoint is away from its level's: more than corners.py's margin
MASK_MARGIN = 8  # pixels of a level: half a descriptor's patch may show what is masked, no more
HIGHEST_THRESHOLD = 25  # of FAST
ENOUGH = 0.95  # of what is wanted; from there on weaker corners would only be thrown away
FAR_TOO_FEW = 0.4  # of what is wanted: the light has changed, and the threshold does not fit any more
DIM = 0.3  # of the lowest threshold: where even that finds too little, in the dark and at plain walls
SMOOTHING = (5, 5), 1.0  # pixels, sigma, of what is searched there: noise has no more corners than before
_response = attrgetter("response")  # faster than a loop


class OrbPyramid:
    """Corners of one image at every level, and descriptors of those among them that are wanted."""

    def __init__(self, factors: Array, lowest_threshold: int, most: int, few: int = 0) -> None:
        """``factors`` (levels,) are the levels' scales, the first one 1; ``most``, ``few``: see limit()."""
        self._factors = factors
        # In single precision and from a ratio in single precision, to be OpenCV's to the last digit.
        ratio = np.float64(np.float32(factors[1])) if len(factors) > 1 else 1.0
        self._enlarged = (ratio ** np.arange(len(factors))).astype(np.float32)
        self._lowest = self._threshold = lowest_threshold
        self._dimmest = max(round(DIM * lowest_threshold), 1)
        self._detectors = [
            cv2.ORB.create(
                nlevels=1,
                edgeThreshold=BORDER,
                scoreType=cv2.ORB_FAST_SCORE,
                patchSize=PATCH,
                fastThreshold=lowest_threshold,
            )
            for _ in factors
        ]
        self.limit(most, few)
        self._shown: NDArray[np.bool_] | None = None
        self._masks: list[Grey | None] = [None] * len(factors)
        self._images: list[Grey] = []
        self._found: list[Sequence[cv2.KeyPoint]] = []

    def limit(self, most: int, few: int) -> None:
        """Share ``most`` corners out, each level as many for its length as any other.

        Where an image has fewer than ``few``, weaker ones are taken, too.
        """
        self._most, self._few = most, few
        shares = np.rint(most / self._factors / (1.0 / self._factors).sum()).astype(int)
        shares[-1] = most - shares[:-1].sum()
        for detector, share in zip(self._detectors, shares.tolist(), strict=True):
            detector.setMaxFeatures(max(share, 1))

    def look_only_at(self, shown: NDArray[np.bool_]) -> None:
        """From now on, find corners only where ``shown`` (height, width), as large as the images, is True."""
        self._shown, self._masks = shown, []

    def detect(self, grey: Grey) -> tuple[NDArray[np.float32], Index, NDArray[np.uint16]]:
        """Strongest corners of a grey image: pixels (n, 2), levels (n,), ascending, and strengths (n,).

        Pixels are a level's times its factor (OpenCV's way, features.py has the other).
        """
        self._images = self._scaled(grey)
        if self._shown is not None and not self._masks:
            self._masks = [_mask(self._shown, image.shape) for image in self._images]
        counts = self._search(self._images, self._threshold)
        at_first = sum(counts)
        if self._threshold > self._lowest and at_first < FAR_TOO_FEW * self._most:
            counts = self._search(self._images, self._lowest)
        if sum(counts) < self._few:
            counts = self._search([_smoothed(image) for image in self._images], self._dimmest)
        levels = np.repeat(np.arange(len(counts)), counts)
        pixels = np.concatenate([_pixels(found) for found in self._found])
        pixels *= self._enlarged[levels, None]
        strengths = map(_response, chain.from_iterable(self._found))
        self._adapt(at_first)  # step by step: it may have been one blurred image
        return pixels, levels, np.fromiter(strengths, np.uint16, len(pixels))

    def describe(self, chosen: Index) -> NDArray[np.uint8]:
        """Descriptors (n, 32) of some of what :meth:`detect` last found, by its index, ascending."""
        described = []
        ends = np.cumsum([len(found) for found in self._found])
        parts = np.split(chosen, np.searchsorted(chosen, ends[:-1]))
        for level, part in enumerate(parts):
            if len(part):
                found, first = self._found[level], int(ends[level]) - len(self._found[level])
                wanted = list(map(found.__getitem__, (part - first).tolist()))
                described.append(self._detectors[level].compute(self._images[level], wanted)[1])
        return np.concatenate(described) if described else np.zeros((0, 32), np.uint8)

    def _search(self, images: Sequence[Grey], threshold: int) -> list[int]:
        """Find corners in every level's image; returns how many."""
        for detector in self._detectors:
            detector.setFastThreshold(threshold)
        at_levels = zip(self._detectors, images, self._masks, strict=False)
        self._found = [detector.detect(image, mask) for detector, image, mask in at_levels]
        return [len(found) for found in self._found]

    def _scaled(self, grey: Grey) -> list[Grey]:
        """The image at each level; the first always, a later one only where a keypoint has room."""
        images = [grey]
        for factor in self._factors[1:]:
            size = round(grey.shape[1] / factor), round(grey.shape[0] / factor)
            if min(size) <= 2 * BORDER:
                break
            smaller = cv2.resize(images[-1], size, interpolation=cv2.INTER_LINEAR_EXACT)
            images.append(np.asarray(smaller, np.uint8))
        return images

    def _adapt(self, found: int) -> None:
        """Follow the texture: FAST's time goes into corners that are thrown away afterwards."""
        enough = found > ENOUGH * self._most
        threshold = min(self._threshold + 1, HIGHEST_THRESHOLD) if enough else self._threshold - 2
        self._threshold = max(threshold, self._lowest)


def _smoothed(image: Grey) -> Grey:
    size, sigma = SMOOTHING
    return np.asarray(cv2.GaussianBlur(image, size, sigma), np.uint8)


def _mask(shown: NDArray[np.bool_], shape: tuple[int, ...]) -> Grey:
    """What of a level may have corners, as OpenCV wants it, MASK_MARGIN away from what may not."""
    level = cv2.resize(shown.astype(np.uint8), shape[::-1], interpolation=cv2.INTER_NEAREST)
    side = 2 * MASK_MARGIN + 1
    return np.asarray(cv2.erode(level, np.ones((side, side), np.uint8)), np.uint8)


def _pixels(found: Sequence[cv2.KeyPoint]) -> NDArray[np.float32]:
    return np.asarray(cv2.KeyPoint.convert(found), dtype=np.float32).reshape(-1, 2)
