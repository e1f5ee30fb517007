"""The static sequence: images, camera, poses and sensor depth by frame."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from prism_edge.config import SourceConfig
from prism_edge.errors import SourceError
from prism_edge.evaluation.trajectory import read_tum
from prism_edge.geometry.poses import inverse, se3_exp, se3_log
from prism_edge.sources.open import find_listing, open_source
from prism_edge.sources.sensor_depth import SensorDepth
from prism_edge.sources.truth import read_truth

Array = NDArray[np.float64]
SEVEN_SCENES_DEPTH_FOCAL = 585.0  # pixels at 640; the depth camera of a 7-Scenes folder isn't registered


def empty(out: Path) -> None:
    """Raises SourceError where a folder for a recording holds something, which would be played too."""
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise SourceError(f"{out} is there already and not empty; name a new folder")


class Recording:
    """A TUM RGB-D or 7-Scenes folder with depth; ``stamps`` in seconds, ``poses`` world_from_camera."""

    def __init__(self, folder: Path, poses: Path | None) -> None:
        """Raises SourceError where something is missing."""
        self.folder = folder
        self.listing = find_listing(folder)
        with open_source(SourceConfig(uri=str(folder))) as source:
            self.camera = source.camera
        if not self.camera.is_ideal:
            raise SourceError(f"{folder}: its lens bends rays; objects are drawn for an ideal camera")
        self._depth = SensorDepth(folder)
        self.stamps = np.array(self.listing.stamps_ns) * 1e-9
        truth = read_truth(str(folder))
        if poses is not None:
            given = read_tum(poses)
            truth = given.stamps, given.poses
        if truth is None:
            raise SourceError(f"{folder} holds no true poses; give them with --poses FILE.tum")
        self.poses = interpolated(np.asarray(truth[0]) * 1e-9, truth[1], self.stamps)

    def depth(self, index: int, step: int = 1) -> Array:
        """True depth (h, w) at every ``step``-th pixel of the colour image, inf where nothing is known."""
        raw = self._depth.read(index)
        rows, columns = np.arange(0, self.camera.height, step), np.arange(0, self.camera.width, step)
        if raw is None:
            return np.full((len(rows), len(columns)), np.inf)
        scale, shift = self.to_sensor(raw.shape)
        y = np.clip(np.rint(rows * scale[1] + shift[1]), 0, raw.shape[0] - 1).astype(np.int64)
        x = np.clip(np.rint(columns * scale[0] + shift[0]), 0, raw.shape[1] - 1).astype(np.int64)
        return filled(raw.astype(np.float64))[np.ix_(y, x)]

    def to_sensor(self, shape: tuple[int, ...]) -> tuple[Array, Array]:
        """Scale and shift (2,) from colour to sensor pixels (x, y)."""
        size = np.array([self.camera.width, self.camera.height], dtype=float)
        ratio = np.array([shape[1], shape[0]]) / size
        if self.listing.layout == "7-Scenes":
            zoom = SEVEN_SCENES_DEPTH_FOCAL / np.array([self.camera.fx, self.camera.fy])
            centre = np.array([self.camera.cx, self.camera.cy])
            return ratio * zoom, ratio * (centre - zoom * centre)
        return ratio, 0.5 * (ratio - 1.0)

    def sensor_file(self, index: int) -> Path | None:
        """The depth image of a colour image; None where it has none."""
        return self._depth.file(index)


def interpolated(times: Array, poses: Array, wanted: Array) -> Array:
    """Poses (n, 4, 4) at ``wanted`` times, along the geodesic between neighbours; held beyond the ends."""
    right = np.clip(np.searchsorted(times, wanted), 1, len(times) - 1)
    made = []
    for at, i in zip(wanted, right.tolist(), strict=True):
        share = float(np.clip((at - times[i - 1]) / (times[i] - times[i - 1]), 0.0, 1.0))
        made.append(poses[i - 1] @ se3_exp(share * se3_log(inverse(poses[i - 1]) @ poses[i])))
    return np.array(made)


def smoothed(times: Array, poses: Array, sigma: float) -> Array:
    """Poses (n, 4, 4) averaged over a Gaussian window in time (positions, and axes made orthogonal again)."""
    weights = np.exp(-0.5 * ((times[:, None] - times[None, :]) / sigma) ** 2)
    weights /= weights.sum(axis=1, keepdims=True)
    mean = np.einsum("ij,jkl->ikl", weights, poses)
    u, _, vt = np.linalg.svd(mean[:, :3, :3])
    mean[:, :3, :3] = u @ vt
    return mean


def filled(depth: Array) -> Array:
    """Depth whose invalid pixels (0) take the value of the nearest valid one; inf where there is none."""
    invalid = (depth <= 0).astype(np.uint8)
    if invalid.all():
        return np.full(depth.shape, np.inf)
    if not invalid.any():
        return depth
    _, labels = cv2.distanceTransformWithLabels(invalid, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    value_of = np.zeros(labels.max() + 1)
    value_of[labels[invalid == 0]] = depth[invalid == 0]
    return np.asarray(value_of[labels])
