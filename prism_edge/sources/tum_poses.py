"""Poses as TUM files have them: one set of rules for all.

Ground truth and estimates for the scorer, and the way that a simulated camera follows; none else reads them.
"""

from __future__ import annotations

import logging
import math
from pathlib import Path

import numpy as np

from prism_edge.errors import SourceError
from prism_edge.geometry.poses import Array, from_rt, rotation_from_quaternion
from prism_edge.sources.listing import lines_of
from prism_edge.sources.stamps import parse_seconds

log = logging.getLogger("prism_edge.sources")


def read_poses(path: Path) -> list[tuple[int, Array]]:
    """(stamp_ns, pose (4, 4)) of each line ``stamp tx ty tz qx qy qz qw``, as they stand; # begins a comment.

    Stamps are seconds, kept to the nanosecond. Poses that are not finite are left out, with one warning that
    counts them. Raises SourceError naming the file, and the line where it has one: of a file that can't be
    read, a line that is no pose (a quaternion's length is 1 to a tenth), and poses none of which is finite.
    """
    rows, left_out = [], ""
    lines = lines_of(path)
    for number, words in lines:
        where = f"{path} line {number}"
        pose = _numbers(words, where)
        if not np.isfinite(pose).all():
            left_out = left_out or where
            continue
        if not 0.9 < math.hypot(*pose[3:]) < 1.1:
            raise SourceError(f"{where}: the quaternion is not of length one")
        try:
            stamp = parse_seconds(words[0])
        except ValueError as error:
            raise SourceError(f"{where}: {error}") from None
        rows.append((stamp, from_rt(rotation_from_quaternion(pose[3:]), pose[:3])))
    if left_out and not rows:
        raise SourceError(f"{left_out}: not finite, nor is any other pose of it")
    if left_out:
        count = len(lines) - len(rows)
        log.warning("%s: not finite; %d of %d poses are such, and left out", left_out, count, len(lines))
    return rows


def _numbers(words: list[str], where: str) -> Array:
    """Position and quaternion (x, y, z, w) of a line (7,)."""
    if len(words) != 8:
        raise SourceError(f"{where}: {len(words)} fields, but a pose has 8 (stamp, xyz, quaternion xyzw)")
    try:
        return np.array([float(word) for word in words[1:]])
    except ValueError:
        raise SourceError(f"{where}: a field of the pose is not a number") from None
