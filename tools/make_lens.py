"""A recording as another lens would have taken it (bent and wide lenses of recordings with a straight one).

    python tools/make_lens.py FOLDER CAMERA OUT [--count N] [--poses TUM]

FOLDER is anything that `prism-edge run` plays, a simulated world among it, whose images need no undistortion;
CAMERA a camera file (docs/CAMERAS.md) of the lens to see it through. OUT becomes a folder of the TUM RGB-D
layout: images, rgb.txt, camera.yaml for `--camera`, and where FOLDER has them true poses and depth. What
FOLDER's images don't show is black. A pixel is the mean of those of the image that it covers, so FOLDER is
to have as many pixels for an angle as the lens, or more: a simulated world is asked for larger images.
"""

from __future__ import annotations

import argparse
import shutil
import sys
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from prism_edge.config import SourceConfig
from prism_edge.errors import PrismError, SourceError, in_words
from prism_edge.evaluation.trajectory import Trajectory, read_tum, write_tum
from prism_edge.geometry.cameras import Camera
from prism_edge.geometry.field_of_view import has_ideal_pixel
from prism_edge.messages import F32
from prism_edge.sources import open_source
from prism_edge.sources.base import Image
from prism_edge.sources.camera_file import read_camera
from prism_edge.sources.sensor_depth import SensorDepth
from prism_edge.sources.sim import SimSource
from prism_edge.sources.stamps import write_seconds
from tools.distractors.recording import empty
from tools.true_poses import own_truth, pose_of_image

FINER = 3  # samples a pixel, each way
UNITS = 5000.0  # of TUM's depth images, a metre


class Lens:
    """What ``camera`` sees of the images of ``straight``, an ideal camera in the same place."""

    def __init__(self, straight: Camera, camera: Camera) -> None:
        self._samples = _sought(straight, camera.resized(FINER * camera.width, FINER * camera.height))
        self._centres = _sought(straight, camera)
        self._size, self._straight = (camera.width, camera.height), (straight.width, straight.height)

    def image(self, pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The image (h, w) or (h, w, 3) that it takes."""
        fine = cv2.remap(pixels, *self._samples, cv2.INTER_LINEAR)
        return np.asarray(cv2.resize(fine, self._size, interpolation=cv2.INTER_AREA), np.uint8)

    def depth(self, metres: F32) -> F32:
        """Depth along the optical axis (h, w), 0 for none, of the straight camera's, whatever its size.

        The nearest pixel's: means of two depths belong to nothing.
        """
        metres = np.asarray(cv2.resize(metres, self._straight, interpolation=cv2.INTER_NEAREST), np.float32)
        return np.asarray(cv2.remap(metres, *self._centres, cv2.INTER_NEAREST), np.float32)


def _sought(straight: Camera, camera: Camera) -> tuple[F32, F32]:
    """Columns and rows (h, w) of the straight image where ``camera``'s pixels look; far outside: no ray."""
    row, column = np.mgrid[: camera.height, : camera.width]
    raw = np.column_stack([column.ravel(), row.ravel()]).astype(np.float64)
    ideal = camera.undistort_pixels(raw)
    at = straight.to_pixels(camera.on_plane(ideal))
    at[~has_ideal_pixel(camera, raw, ideal)] = -1e4
    x, y = at.T.reshape(2, camera.height, camera.width).astype(np.float32)
    return x, y


def write(folder: str, lens: Camera, out: Path, count: int = 0, poses: Path | None = None) -> int:
    """Writes the recording; returns how many images it has. Raises PrismError for unusable folders."""
    empty(out)
    reference, truth = None if poses is None else read_tum(poses), own_truth(folder)
    told: list[tuple[int, str]] = []  # stamp, file of each image
    source = open_source(SourceConfig(uri=folder))
    with source:
        if not source.camera.is_ideal:
            raise SystemExit("the camera has distortion: its images would have to be undistorted first")
        seen = Lens(source.camera, lens)
        sensor = _depth_of(source, folder)
        for kind in ("rgb",) if sensor is None else ("rgb", "depth"):
            (out / kind).mkdir(parents=True, exist_ok=True)
        while (image := source.read()) is not None and (count == 0 or len(told) < count):
            if not isinstance(image, Image) or (told and image.stamp_ns <= told[-1][0]):
                continue
            name = f"{image.index:06d}.png"
            _save(out / "rgb" / name, seen.image(image.pixels))
            depth = None if sensor is None else _metres(sensor, image.index, source.camera)
            if depth is not None:
                raw = np.where(depth * UNITS < 65535.0, np.rint(depth * UNITS), 0.0)
                _save(out / "depth" / name, seen.depth(raw.astype(np.float32)).astype(np.uint16))
            told.append((image.stamp_ns, name))
    if not told:
        raise SystemExit(f"{folder}: no image could be read")
    for kind in ("rgb", "depth"):
        there = [(write_seconds(ns), name) for ns, name in told if (out / kind / name).is_file()]
        if there:
            (out / f"{kind}.txt").write_text("".join(f"{stamp} {kind}/{name}\n" for stamp, name in there))
    for trajectory, file in ((truth, "groundtruth.txt"), (reference, "reference.tum")):
        if trajectory is not None and len(trajectory):
            at = ((ns, pose_of_image(trajectory, ns)) for ns, _ in told)
            write_tum(out / file, Trajectory.of((ns, pose) for ns, pose in at if pose is not None))
    return len(told)


def _depth_of(source: object, folder: str) -> SimSource | SensorDepth | None:
    """Where the depth of its images is to be had; None where nowhere."""
    if isinstance(source, SimSource):
        return source
    try:
        return SensorDepth(Path(folder))
    except SourceError:
        return None


def _metres(sensor: SimSource | SensorDepth, index: int, camera: Camera) -> F32 | None:
    return sensor.depth(index) if isinstance(sensor, SimSource) else sensor.in_colour(index, camera)


def _save(path: Path, pixels: NDArray[np.uint8] | NDArray[np.uint16]) -> None:
    if not cv2.imwrite(str(path), pixels, [cv2.IMWRITE_PNG_COMPRESSION, 1]):
        raise SystemExit(f"{path}: can't write images there")


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description="A recording as another lens would have taken it.")
    parser.add_argument("folder", help="recording or simulated world to take")
    parser.add_argument("camera", type=Path, help="camera file of the lens")
    parser.add_argument("out", type=Path, help="folder to write")
    parser.add_argument("--count", type=int, default=0, metavar="N", help="of so many images (default: all)")
    parser.add_argument("--poses", type=Path, metavar="TUM", help="a reference to carry along")
    given = parser.parse_args()
    try:
        count = write(given.folder, read_camera(given.camera), given.out, given.count, given.poses)
        shutil.copyfile(given.camera, given.out / "camera.yaml")
    except (PrismError, OSError) as error:
        sys.exit(in_words(error))
    print(f"{count} images in {given.out}")


if __name__ == "__main__":
    main()
