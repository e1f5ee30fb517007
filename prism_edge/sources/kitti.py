"""KITTI odometry layout: image_2 (colour) or image_0 (grey), calib.txt, times.txt."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np

from prism_edge.errors import ConfigError, SourceError
from prism_edge.geometry.cameras import Camera
from prism_edge.geometry.poses import Array, from_rt
from prism_edge.sources.image_file import SUFFIXES, read_image
from prism_edge.sources.listing import Intrinsics, Listing, files_in, lines_of
from prism_edge.sources.stamps import parse_seconds

_CAMERAS = {"image_2": "P2", "image_0": "P0"}  # colour before grey
_MOST_BESIDE = 0.6  # of a thinned sequence's images have their next beside them, as pairs that were kept
_GLOBAL_MS = 0.0  # its cameras have global shutters
TABLES = "calib.txt and times.txt come with the benchmark's data_odometry_calib.zip"


def find(folder: Path, rate_hz: float) -> Listing | None:
    """The sequence in a folder, None where its layout is another; SourceError where tables are damaged."""
    if not image_folders(folder) or not (folder / "calib.txt").is_file():
        return None
    name, images = _played(folder)
    if not (folder / "times.txt").is_file():
        raise SourceError(f"{folder} has KITTI's {name} but no times.txt: {TABLES}")
    times = read_times(folder / "times.txt")
    if images and int(images[-1].stem) >= len(times):
        table = folder / "times.txt"
        raise SourceError(f"{table} has {len(times)} times, too few for image {images[-1].name}")
    step = _step([int(path.stem) for path in images])
    images = _with_gaps(images) if step == 1 else images
    before, after = (int(images[0].stem), len(times) - 1 - int(images[-1].stem)) if images else (0, 0)
    missing = before + after if max(before, after) >= step else 0
    return Listing(
        "KITTI odometry",
        tuple(images),
        tuple(times[int(path.stem)] for path in images),
        lambda: _intrinsics(folder / "calib.txt", _CAMERAS[name], images),
        doubt=f"{name} begins or ends without {missing} images of times.txt" if missing > 0 else "",
    )


def _played(folder: Path) -> tuple[str, list[Path]]:
    """The camera that is played, colour unless its folder is empty, and its images."""
    for name in image_folders(folder):
        files = files_in(folder / name)  # labels or depth of the same numbers may lie beside the images
        images = [path for path in files if path.suffix.lower() in SUFFIXES and path.stem.isdecimal()]
        if images:
            break
    return name, images


def _step(numbers: list[int]) -> int:
    """From one image to the next in a sequence that was thinned: all alike, or most are left out; else 1.

    Where most images have their next beside them, stretches of it are missing.
    """
    if len(numbers) < 3:
        return 1
    steps = [after - before for before, after in pairwise(numbers)]
    length = numbers[-1] - numbers[0]
    thinned = 2 * len(numbers) <= length and steps.count(1) <= _MOST_BESIDE * len(steps)
    return length // len(steps) if thinned or len(set(steps)) == 1 else 1


def _with_gaps(images: list[Path]) -> list[Path]:
    """The same with a name for each number that is missing in between, which then can't be read."""
    out: list[Path] = []
    for path in images:
        for number in range(int(out[-1].stem) + 1, int(path.stem)) if out else ():
            out.append(path.with_stem(f"{number:0{len(path.stem)}d}"))
        out.append(path)
    return out


def read_times(path: Path) -> list[int]:
    """Stamps (ns), one a line; raises SourceError naming file and line."""
    times = []
    for number, words in lines_of(path):
        try:
            (word,) = words
            times.append(parse_seconds(word))
        except ValueError:
            raise SourceError(f"{path} line {number}: expected one time in seconds") from None
    return times


def camera0_from_played(folder: Path) -> Array:
    """The pose (4, 4), metres, of the camera that is played in camera 0, whose path poses.txt is.

    Rectified cameras differ by a translation t alone: P2 = K [I | t]. Raises ConfigError where calib.txt is
    damaged.
    """
    name, _ = _played(folder)
    if name == "image_0":
        return np.eye(4)
    path = folder / "calib.txt"
    number, numbers = _projection(path, _CAMERAS[name])
    p = np.array(numbers).reshape(3, 4)
    try:
        return from_rt(np.eye(3), -np.linalg.solve(p[:, :3], p[:, 3]))
    except np.linalg.LinAlgError:
        raise ConfigError(f"{path} line {number}: no camera projects so") from None


def image_folders(folder: Path) -> list[str]:
    """Names of those of its cameras that can be played, best first; nothing is read."""
    return [name for name in _CAMERAS if (folder / name).is_dir()]


def _projection(path: Path, key: str) -> tuple[int, list[float]]:
    """Line number and the 12 numbers, row by row, of P0 or P2 of calib.txt."""
    rows = {words[0].rstrip(":"): (number, words[1:]) for number, words in lines_of(path)}
    if key not in rows:
        raise ConfigError(f"{path} has no line {key}:")
    number, words = rows[key]
    try:
        p = [float(word) for word in words]
        if len(p) != 12 or not np.all(np.isfinite(p)):
            raise ValueError
    except ValueError:
        raise ConfigError(f"{path} line {number}: expected 12 numbers after {key}:") from None
    return number, p


def _intrinsics(path: Path, key: str, images: list[Path]) -> Intrinsics:
    """Projection matrix P0 or P2 of calib.txt: the images are rectified, so it says all but their size."""
    number, p = _projection(path, key)
    for image in images:
        pixels = read_image(image)
        if not isinstance(pixels, str):
            height, width = pixels.shape[:2]
            try:
                camera = Camera(width, height, p[0], p[5], p[2], p[6], readout_ms=_GLOBAL_MS)
                return f"{key} of {path.name}", camera
            except ConfigError as error:
                raise ConfigError(f"{path} line {number}: {error}") from None
    raise SourceError(f"{path.parent} has no readable image")
