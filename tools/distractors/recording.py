"""The static sequence: images, camera, poses and sensor depth by frame."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from prism_edge.config import SourceConfig
from prism_edge.errors import SourceError
from prism_edge.evaluation.trajectory import read_tum
from prism_edge.geometry.cameras import Camera
from prism_edge.geometry.poses import inverse, se3_exp, se3_log
from prism_edge.sources.bonn import holds_markers
from prism_edge.sources.listing import lines_of
from prism_edge.sources.open import find_listing, open_source
from prism_edge.sources.sensor_depth import COLOUR_IN_DEPTH, DEPTH_CAMERA, SensorDepth
from prism_edge.sources.truth import read_truth

Array = NDArray[np.float64]


def empty(out: Path) -> None:
    """Raises SourceError where a folder for a recording holds something, which would be played too.

    So it does where the folder has a name of BONN's: the camera's true poses would be taken for the markers'.
    """
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise SourceError(f"{out} is there already and not empty; name a new folder")
    if holds_markers(out):
        raise SourceError(f"{out}: rgbd_bonn_* is for recordings with BONN's own truth; name another folder")


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
        for file in (*self.listing.files, *(self.sensor_file(i) for i in range(len(self.listing.files)))):
            if file is not None:
                self.inside(file)
        for table in (folder / "rgb.txt", folder / "depth.txt"):
            for number, words in lines_of(table) if table.is_file() else ():
                if len(words) > 1 and Path(words[1]).is_absolute():
                    raise SourceError(f"{table} line {number}: a path of its own, which OUT would share")
        self.stamps = np.array(self.listing.stamps_ns) * 1e-9
        truth = read_truth(str(folder))
        if poses is not None:
            given = read_tum(poses)
            truth = given.stamps, given.poses
        if truth is None:
            raise SourceError(f"{folder} holds no true poses; give them with --poses FILE.tum")
        times = np.asarray(truth[0], np.float64) * 1e-9
        among = len(times) > 1 and np.mean((self.stamps >= times[0]) & (self.stamps <= times[-1])) > 0.5
        if not among:
            raise SourceError(f"{poses or folder}: its poses are of other times than most images")
        self.poses = interpolated(times, truth[1], self.stamps)

    def inside(self, file: Path) -> Path:
        """Where a file lies in the folder, and in OUT. Raises SourceError for one that lies elsewhere."""
        relative = Path(os.path.relpath(file, self.folder))
        if relative.parts[:1] == (os.pardir,):
            raise SourceError(f"{file} is not in {self.folder}: OUT would have no place for it")
        return relative

    def depth(self, index: int, step: int = 1) -> Array:
        """True depth (h, w) at every ``step``-th pixel of the colour image, inf where nothing is known."""
        seen = self._depth.in_colour(index, self.camera)
        rows, columns = np.arange(0, self.camera.height, step), np.arange(0, self.camera.width, step)
        if seen is None:
            return np.full((len(rows), len(columns)), np.inf)
        rows = nearest(rows, self.camera.height, seen.shape[0])
        columns = nearest(columns, self.camera.width, seen.shape[1])
        return filled(seen.astype(np.float64))[np.ix_(rows, columns)]

    def in_sensor(self, shown: Array, shape: tuple[int, ...]) -> Array:
        """Depth (h, w) of the colour image as the depth image of that shape sees it; inf where it sees none.

        The other way round than :meth:`depth`.
        """
        if self._depth.is_apart(self.camera):
            return seen_by_sensor(shown, self.camera, shape)
        rows, columns = (nearest(np.arange(n), n, m) for n, m in zip(shape, shown.shape, strict=True))
        return shown[np.ix_(rows, columns)]

    def sensor_file(self, index: int) -> Path | None:
        """The depth image of a colour image; None where it has none."""
        return self._depth.file(index)


def nearest(pixels: NDArray[np.int64], of: int, among: int) -> NDArray[np.int64]:
    """The nearest of ``among`` pixels that lie over the same length as ``of``, to whole ones of those."""
    there = np.rint((pixels + 0.5) * (among / of) - 0.5)
    return np.clip(there, 0, among - 1).astype(np.int64)


def seen_by_sensor(shown: Array, camera: Camera, shape: tuple[int, ...]) -> Array:
    """Depth of 7-Scenes' colour camera, inf for none, as its depth camera of that shape sees it."""
    # Finer than the pixels, since the depth camera's are smaller, and would be passed over.
    rows, columns = np.nonzero(np.isfinite(np.repeat(np.repeat(shown, 2, axis=0), 2, axis=1)))
    z = shown[rows // 2, columns // 2]
    x = (0.5 * (columns + 0.5) - 0.5 - camera.cx) / camera.fx * z
    y = (0.5 * (rows + 0.5) - 0.5 - camera.cy) / camera.fy * z
    points = np.column_stack([x, y, z]) + COLOUR_IN_DEPTH
    fx, fy, cx, cy = DEPTH_CAMERA
    step = 640.0 / shape[1]
    pixels = (points[:, :2] / points[:, 2:] * (fx, fy) + (cx, cy) + 0.5) / step - 0.5
    there = np.rint(pixels).astype(np.int64)
    inside = np.all((there >= 0) & (there < (shape[1], shape[0])), axis=1)
    seen = np.full(shape, np.inf)
    np.minimum.at(seen, (there[inside, 1], there[inside, 0]), points[inside, 2])
    return seen


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
