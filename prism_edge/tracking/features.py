"""ORB features, spread over the image, with an index for searches round a pixel."""

from __future__ import annotations

from dataclasses import dataclass, field
from operator import attrgetter

import cv2
import numpy as np
from numpy.typing import NDArray

from prism_edge.config import TrackingConfig
from prism_edge.geometry.cameras import Camera
from prism_edge.geometry.poses import Array
from prism_edge.tracking.corners import are_corners

Index = NDArray[np.intp]
HIGHEST_THRESHOLD = 25  # of FAST
CELL = 16  # pixels; about the radius of a search, so that one touches few cells
FEW_MATCHES, MANY_MATCHES, GROWTH = 170, 200, 1.2
_octave, _response = attrgetter("octave"), attrgetter("response")  # of a keypoint, faster than a loop
VGA, MOST_AREA = (640, 480), 3.0  # what the configured numbers are for; the most that area counts


@dataclass(frozen=True)
class Features:
    """The n keypoints of one image, in ideal (undistorted) pixels."""

    pixels: NDArray[np.float64]  # (n, 2)
    octaves: NDArray[np.intp]  # (n,)
    descriptors: NDArray[np.uint64]  # (n, 4): 256 bits each
    order: Index = field(repr=False)  # keypoints sorted by grid cell, row by row
    cell_start: Index = field(repr=False)  # where each cell begins in ``order``; one more at the end
    columns: int
    rows: int

    def __len__(self) -> int:
        return len(self.pixels)

    @classmethod
    def build(
        cls,
        pixels: NDArray[np.float64],
        octaves: NDArray[np.intp],
        descriptors: NDArray[np.uint64],
        width: int,
        height: int,
    ) -> Features:
        """Index keypoints; those outside the image are filed in its border cells."""
        columns, rows = width // CELL + 1, height // CELL + 1
        column, row = np.clip(pixels / CELL, 0, (columns - 1, rows - 1)).astype(np.intp).T
        cell = row * columns + column
        order = np.argsort(cell, kind="stable")
        cell_start = np.searchsorted(cell[order], np.arange(columns * rows + 1))
        return cls(pixels, octaves, descriptors, order, cell_start, columns, rows)

    def through(self, lens: Camera, was: Camera) -> Features:
        """The same keypoints where another lens has them; ``was`` is the camera they were undistorted by."""
        pixels = lens.pixels_of(was, self.pixels)
        return Features.build(pixels, self.octaves, self.descriptors, lens.width, lens.height)


class OrbExtractor:
    """OpenCV's ORB with its keypoints thinned to an even spread.

    OpenCV keeps the strongest responses wherever they cluster; a pose rests better on corners from
    all over the image. So more are detected than wanted, and each grid cell keeps its strongest.

    Points of straight edges are left out (corners.py).
    """

    surplus = 1.6  # detected per kept; more costs time and brings little
    spread_cell = 32  # pixels

    def __init__(self, config: TrackingConfig) -> None:
        self._config = config
        self._size = VGA
        self._least, self._most = config.features, max(config.features, config.max_features)
        self._wanted = self._most  # a first map can't have too many
        self.scale_factors: Array = config.scale_factor ** np.arange(config.levels, dtype=np.float64)
        self._lowest = self._threshold = config.fast_threshold
        self._orb = cv2.ORB.create(
            nfeatures=int(self._wanted * self.surplus),
            scaleFactor=config.scale_factor,
            nlevels=config.levels,
            edgeThreshold=19,  # more than corners.py's margin
            scoreType=cv2.ORB_FAST_SCORE,
            patchSize=31,
            fastThreshold=config.fast_threshold,
        )

    def extract(self, grey: NDArray[np.uint8], camera: Camera) -> Features:
        """Features of a grey image (height, width); an image without corners gives none."""
        if (grey.shape[1], grey.shape[0]) != self._size:
            self._fit((grey.shape[1], grey.shape[0]))
        keypoints, descriptors = self._orb.detectAndCompute(grey, None)
        if descriptors is None or not len(keypoints):
            keypoints, descriptors = (), np.zeros((0, 32), np.uint8)
        self._adapt(len(keypoints))
        pixels = np.asarray(cv2.KeyPoint.convert(keypoints), dtype=np.float32).reshape(-1, 2)
        octaves = np.fromiter(map(_octave, keypoints), np.intp, len(keypoints))
        chosen = np.flatnonzero(are_corners(grey, pixels, octaves, self.scale_factors))
        if len(chosen) > self._wanted:
            strength = np.fromiter(map(_response, keypoints), np.float64, len(keypoints))
            chosen = chosen[self._spread(pixels[chosen], strength[chosen], grey.shape[1])]
        pixels, octaves, descriptors = pixels[chosen], octaves[chosen], descriptors[chosen]
        raw = _in_full_image(pixels.astype(np.float64), octaves, self.scale_factors, grey.shape)
        packed = np.ascontiguousarray(descriptors).view(np.uint64)
        ideal = camera.undistort_pixels(raw)
        # A fisheye's rim has no pinhole pixel.
        inside = np.all(np.abs(ideal - raw) < 2.0 * max(grey.shape), axis=1)
        return Features.build(ideal[inside], octaves[inside], packed[inside], grey.shape[1], grey.shape[0])

    def _fit(self, size: tuple[int, int]) -> None:
        """A larger image needs as many more features as it shows more; a smaller one not fewer."""
        share = min(max(size[0] * size[1] / (VGA[0] * VGA[1]), 1.0), MOST_AREA)
        self._size = size
        self._least = int(share * self._config.features)
        self._most = int(share * max(self._config.features, self._config.max_features))
        self._wanted = self._most
        self._orb.setMaxFeatures(int(self._wanted * self.surplus))

    def want(self, matched: int) -> None:
        """Follow the matches: a scene that changes fast between frames needs more corners to hold on to."""
        if matched < FEW_MATCHES:
            wanted = min(int(GROWTH * self._wanted), self._most)
        elif matched > MANY_MATCHES:
            wanted = max(int(self._wanted / GROWTH), self._least)
        else:
            return
        if wanted != self._wanted:
            self._wanted = wanted
            self._orb.setMaxFeatures(int(wanted * self.surplus))

    def _adapt(self, found: int) -> None:
        """Follow the texture: FAST's time goes into corners that are thrown away afterwards."""
        enough = found > 0.95 * self.surplus * self._wanted
        threshold = min(self._threshold + 1, HIGHEST_THRESHOLD) if enough else self._threshold - 2
        self._threshold = max(threshold, self._lowest)
        self._orb.setFastThreshold(self._threshold)

    def _spread(self, pixels: NDArray[np.float32], strength: NDArray[np.float64], width: int) -> Index:
        columns = width // self.spread_cell + 1
        at = (pixels * (1.0 / self.spread_cell)).astype(np.intp)
        cell = at[:, 1] * columns + at[:, 0]
        # One number to sort by: two take twice as long.
        step = float(strength.max()) + 1.0
        order = np.argsort(step * cell - strength, kind="stable")
        begins = np.diff(cell[order], prepend=-1) > 0
        rank = np.arange(len(order)) - np.flatnonzero(begins)[np.cumsum(begins) - 1]
        # Every cell's best, then every cell's second best, and so on until there are enough.
        return order[np.argsort(step * rank - strength[order], kind="stable")[: self._wanted]]


def _in_full_image(pixels: Array, octaves: Index, factors: Array, shape: tuple[int, ...]) -> Array:
    """Where keypoints (n, 2) of a pyramid really are in the image.

    OpenCV multiplies a level's pixel by the level's factor. But levels have whole numbers of pixels, and
    two pixels' centres coincide at (x + 1/2) / factor: up to a pixel lies between, and another at each level.
    """
    size = np.array([shape[1], shape[0]], np.float64)
    level_size = np.rint(size / factors[:, None])
    factor = factors[octaves][:, None]
    return (pixels / factor + 0.5) * (size / level_size)[octaves] - 0.5
