"""ORB features, spread over the image, with an index for searches round a pixel."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from prism_edge.config import TrackingConfig
from prism_edge.geometry.cameras import Camera
from prism_edge.geometry.field_of_view import has_ideal_pixel
from prism_edge.geometry.poses import Array
from prism_edge.tracking.corners import are_corners
from prism_edge.tracking.orb_pyramid import OrbPyramid
from prism_edge.tracking.point_table import Index
from prism_edge.tracking.sorting import order_of
from prism_edge.tracking.spreading import spread

CELL = 16  # pixels; about the radius of a search, so that one touches few cells
FEW_MATCHES, MANY_MATCHES, GROWTH = 170, 200, 1.2
TOO_FEW = 0.75  # of the features that are wanted at least
VGA, MOST_AREA = (640, 480), 3.0  # what the configured numbers are for; the most that area counts


def grid(width: int, height: int) -> tuple[int, int]:
    """Columns and rows of the cells that an image's keypoints are filed in."""
    return width // CELL + 1, height // CELL + 1


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
        columns, rows = grid(width, height)
        # Not np.clip, which takes several times as long on so few numbers.
        at = np.minimum(np.maximum(pixels * (1.0 / CELL), 0.0), (columns - 1.0, rows - 1.0))
        column, row = at.astype(np.intp).T
        cell = row * columns + column
        order = order_of(cell, columns * rows)
        cell_start = np.zeros(columns * rows + 1, np.intp)
        np.cumsum(np.bincount(cell, minlength=columns * rows), out=cell_start[1:])
        return cls(pixels, octaves, descriptors, order, cell_start, columns, rows)

    def through(self, lens: Camera, was: Camera) -> Features:
        """The same keypoints where another lens has them; ``was`` is the camera they were undistorted by."""
        return self.at(lens.pixels_of(was, self.pixels), lens)

    def at(self, pixels: NDArray[np.float64], camera: Camera) -> Features:
        """The same keypoints elsewhere in the image: at ``pixels`` (n, 2)."""
        return Features.build(pixels, self.octaves, self.descriptors, camera.width, camera.height)


class OrbExtractor:
    """OpenCV's ORB with its keypoints thinned to an even spread.

    OpenCV keeps the strongest responses wherever they cluster; a pose rests better on corners from
    all over the image. So more are detected than wanted, and thinned (spreading.py); only those that are
    left are described. Points of straight edges are left out (corners.py).
    """

    surplus = 2.0  # detected per kept; more costs time and brings little

    def __init__(self, config: TrackingConfig) -> None:
        self._config = config
        self._size = VGA
        self._least, self._most = config.features, max(config.features, config.max_features)
        self._wanted = self._most  # a first map can't have too many
        self.scale_factors: Array = config.scale_factor ** np.arange(config.levels, dtype=np.float64)
        self._orb = OrbPyramid(self.scale_factors, config.fast_threshold, *self._limits())

    def look_only_at(self, shown: NDArray[np.bool_]) -> None:
        """Features only where ``shown`` (height, width), as large as the images to come, is True."""
        self._orb.look_only_at(shown)

    def extract(self, grey: NDArray[np.uint8], camera: Camera) -> Features:
        """Features of a grey image (height, width); an image without corners gives none."""
        if (grey.shape[1], grey.shape[0]) != self._size:
            self._fit((grey.shape[1], grey.shape[0]))
        pixels, octaves, strength = self._orb.detect(grey)
        corners = np.flatnonzero(are_corners(grey, pixels, octaves, self.scale_factors))
        at, strength = pixels.take(corners, axis=0), strength.take(corners)
        chosen = corners.take(spread(at, strength, grey.shape, self._wanted, self._least))
        # Only what is kept is described: in the order of levels, and then back in that of its worth.
        by_level = order_of(chosen, len(pixels))
        described = self._orb.describe(chosen.take(by_level))
        descriptors = np.empty_like(described)
        descriptors[by_level] = described
        pixels, octaves = pixels.take(chosen, axis=0), octaves.take(chosen)
        raw = _in_full_image(pixels.astype(np.float64), octaves, self.scale_factors, grey.shape)
        packed = descriptors.view(np.uint64)
        ideal = camera.undistort_pixels(raw)
        inside = has_ideal_pixel(camera, raw, ideal)
        return Features.build(ideal[inside], octaves[inside], packed[inside], grey.shape[1], grey.shape[0])

    def _fit(self, size: tuple[int, int]) -> None:
        """A larger image needs as many more features as it shows more; a smaller one not fewer."""
        share = min(max(size[0] * size[1] / (VGA[0] * VGA[1]), 1.0), MOST_AREA)
        self._size = size
        self._least = int(share * self._config.features)
        self._most = int(share * max(self._config.features, self._config.max_features))
        self._wanted = self._most
        self._orb.limit(*self._limits())

    def _limits(self) -> tuple[int, int]:
        """How many corners to detect at most, and how many are too few."""
        return int(self._wanted * self.surplus), int(self._least * TOO_FEW)

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
            self._orb.limit(*self._limits())


def _in_full_image(pixels: Array, octaves: Index, factors: Array, shape: tuple[int, ...]) -> Array:
    """Where keypoints (n, 2) of a pyramid really are in the image.

    OpenCV multiplies a level's pixel by the level's factor. But levels have whole numbers of pixels, and
    two pixels' centres coincide at (x + 1/2) / factor: up to a pixel lies between, and another at each level.
    """
    size = np.array([shape[1], shape[0]], np.float64)
    level_size = np.maximum(np.rint(size / factors[:, None]), 1.0)  # of some there is none
    factor = factors[octaves][:, None]
    return (pixels / factor + 0.5) * (size / level_size)[octaves] - 0.5
