"""Ground truth that lies with a dataset, for the scorer alone: nothing that estimates imports this."""

from __future__ import annotations

import logging
import os
import re
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from prism_edge.errors import SourceError
from prism_edge.geometry.poses import Array, are_rotations, from_rt, normalised
from prism_edge.messages import F64, I64
from prism_edge.named_path import named_path
from prism_edge.sources.bonn import camera_from_markers, holds_markers
from prism_edge.sources.kitti import camera0_from_played, read_times
from prism_edge.sources.known_cameras import BY_NAME, by_name
from prism_edge.sources.listing import Listing, lines_of
from prism_edge.sources.open import find_listing
from prism_edge.sources.sim import SimSource, is_simulated
from prism_edge.sources.tum_poses import read_poses

log = logging.getLogger("prism_edge.sources")

# A rotation written with few digits is off by less than this.
_ROTATION_TOLERANCE = 0.01
_NO_NUMBER = re.compile(r"[-+]?1\.#(IND|INF|QNAN|SNAN)[0-9]*")  # how Windows' programs wrote what is none
_AS_IT_IS = (
    "has BONN's camera, but is not called rgbd_bonn_*: its groundtruth.txt is taken for the camera's poses, "
    "not the markers'"
)


def read_truth(uri: str) -> tuple[I64, F64] | None:
    """(stamps_ns (n,), world_from_camera (n, 4, 4), metres) in order of time; None where there is none.

    TUM RGB-D: groundtruth.txt, carried over from the markers to the camera where the folder is BONN's.
    7-Scenes: the frames' .pose.txt, those not finite left out. KITTI odometry: ../../poses/NN.txt as the
    benchmark lays it out, or poses.txt beside the images, which are camera 0's, carried over to the one that
    is played. Simulator: exact, and computed. Raises SourceError naming the file where it is damaged, and
    ConfigError where KITTI's calib.txt is.
    """
    if is_simulated(uri):
        return SimSource(uri).truth()
    folder = named_path(uri)
    if not folder.is_dir():
        return None
    listing = find_listing(folder)
    file = truth_file(folder, listing)
    if file is None:
        return None
    rows: list[tuple[int, Array]] = []
    if listing.layout == "TUM RGB-D":
        rows = read_poses(file)
        if holds_markers(folder):
            rows = [(stamp, camera_from_markers(pose)) for stamp, pose in rows]
        elif rows and (doubt := truth_doubt(folder, listing)):
            log.warning("%s %s", folder, doubt)
    elif listing.layout == "7-Scenes":
        rows = _seven_scenes(zip(listing.stamps_ns, map(_pose_file, listing.files), strict=True))
    elif listing.layout == "KITTI odometry":
        rows = _kitti(folder, file)
    if not rows:
        log.warning("%s holds no pose", file)
        return None
    rows.sort(key=lambda row: row[0])
    return np.array([stamp for stamp, _ in rows], dtype=np.int64), np.array([pose for _, pose in rows])


def truth_file(folder: Path, listing: Listing) -> Path | None:
    """The file that holds a recording's own truth, or the folder of 7-Scenes' many; None: there is none."""
    if listing.layout == "7-Scenes":
        return next((image.parent for image in listing.files if _pose_file(image).is_file()), None)
    candidates: list[Path] = []
    if listing.layout == "TUM RGB-D":
        candidates = [folder / "groundtruth.txt"]
    elif listing.layout == "KITTI odometry":
        # Without `..`, which is no sequence's name; as it is called, and then where a link leads to.
        called = dict.fromkeys((Path(os.path.abspath(folder)), folder.resolve()))
        candidates = [path.parent.parent / "poses" / f"{path.name}.txt" for path in called]
        candidates.append(folder / "poses.txt")
    there = [file for file in candidates if file.is_file()]
    if len(there) > 1:  # a sequence that was cut short has what fits beside it
        count = len(lines_of(folder / "times.txt"))
        there.sort(key=lambda file: len(lines_of(file)) != count)
    return there[0] if there else None


def truth_doubt(folder: Path, listing: Listing) -> str:
    """Why its groundtruth.txt may be of another point than the camera, after the folder's name; empty: no."""
    bonns = listing.layout == "TUM RGB-D" and by_name(folder) == BY_NAME["rgbd_bonn"]
    return _AS_IT_IS if bonns and not holds_markers(folder) else ""


def _pose_file(image: Path) -> Path:
    return image.with_name(image.name.split(".")[0] + ".pose.txt")


def _seven_scenes(pairs: Iterable[tuple[int, Path]]) -> list[tuple[int, Array]]:
    rows = []
    for stamp_ns, path in pairs:
        if path.is_file():
            lines = lines_of(path, comments=False)
            words = ["nan" if _NO_NUMBER.fullmatch(word) else word for _, line in lines for word in line]
            numbers = _numbers(words, 16, str(path), finite=False)
            if np.all(np.isfinite(numbers)):
                rows.append((stamp_ns, _pose(numbers[:12], str(path))))
    return rows


def _kitti(folder: Path, path: Path) -> list[tuple[int, Array]]:
    poses = [
        _pose(_numbers(words, 12, f"{path} line {n}"), f"{path} line {n}") for n, words in lines_of(path)
    ]
    times = read_times(folder / "times.txt")
    if len(poses) != len(times):
        raise SourceError(f"{path} has {len(poses)} poses for the {len(times)} times of times.txt")
    beside = folder / "poses.txt"
    if path != beside and beside.is_file():  # SemanticKITTI unpacks its own estimate there
        log.warning("%s is not read: the benchmark's truth is %s", beside, path)
    camera0_from_camera = camera0_from_played(folder)
    return [(time, pose @ camera0_from_camera) for time, pose in zip(times, poses, strict=True)]


def _numbers(words: list[str], count: int, where: str, finite: bool = True) -> list[float]:
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        numbers = []
    if len(numbers) != count:
        raise SourceError(f"{where}: expected {count} numbers of a pose")
    if finite and not np.all(np.isfinite(numbers)):
        raise SourceError(f"{where}: not finite")
    return numbers


def _pose(numbers: list[float], where: str) -> Array:
    upper = np.array(numbers).reshape(3, 4)
    rotation = upper[:, :3]
    if not are_rotations(rotation, _ROTATION_TOLERANCE):
        raise SourceError(f"{where}: its rotation is none")
    # As exact as what is computed with it takes a rotation to be: 7-Scenes' are 4e-4 off.
    return normalised(from_rt(rotation, upper[:, 3]))
