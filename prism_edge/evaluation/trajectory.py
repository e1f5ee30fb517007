"""Stamped camera poses: reading and writing TUM files, and pairing two trajectories by time."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from prism_edge.all_or_nothing import put_whole
from prism_edge.errors import EvaluationError, SourceError
from prism_edge.geometry.poses import Array, quaternion_from_rotation
from prism_edge.sources.stamps import write_seconds
from prism_edge.sources.tum_poses import read_poses

NS = 1_000_000_000
TOGETHER_NS = NS // 100  # an estimated and a true pose nearer than that are of one moment


@dataclass(frozen=True)
class Trajectory:
    """``stamps`` (n,) int64 nanoseconds that never decrease, ``poses`` (n, 4, 4) world_from_camera."""

    stamps: NDArray[np.int64]
    poses: Array

    def __post_init__(self) -> None:
        if self.stamps.ndim != 1 or self.poses.shape != (len(self.stamps), 4, 4):
            raise ValueError(f"{self.stamps.shape} stamps don't go with {self.poses.shape} poses")
        if np.any(np.diff(self.stamps) < 0):
            raise ValueError("the stamps of a trajectory must not go backwards")

    @classmethod
    def of(cls, rows: Iterable[tuple[int, Array]]) -> Trajectory:
        """A trajectory of (stamp_ns, pose) in any order; equal stamps keep theirs."""
        ordered = sorted(rows, key=lambda row: row[0])
        stamps = np.array([stamp for stamp, _ in ordered], dtype=np.int64)
        return cls(stamps, np.array([pose for _, pose in ordered], dtype=np.float64).reshape(-1, 4, 4))

    def __len__(self) -> int:
        return len(self.stamps)

    @property
    def positions(self) -> Array:
        """Camera centres (n, 3)."""
        return self.poses[:, :3, 3]

    def at(self, rows: NDArray[np.intp]) -> Trajectory:
        """The poses of some rows (an index array or a mask)."""
        return Trajectory(self.stamps[rows], self.poses[rows])


def associate(first: Trajectory, second: Trajectory) -> tuple[Trajectory, Trajectory]:
    """The poses of both that belong together: each of the shorter one with the nearest of the longer.

    Of two that are equally long, ``second`` counts as the shorter. Pairs further apart in time than
    ``TOGETHER_NS`` are left out. All this is evo's nearest-time synchronisation; the two results have equal
    length, possibly zero.
    """
    if len(second) > len(first):
        longer, shorter = _nearest(second, first)
        return shorter, longer
    return _nearest(first, second)


def paired(estimate: Trajectory, truth: Trajectory) -> tuple[Trajectory, Trajectory]:
    """As `associate`, but that each estimated pose counts once, with the true one nearest to it.

    evo's shorter list leads. Dense truth of a part of the run is such a one, and has several poses within the
    tolerance of each frame: the frame would count with each, and be judged against where it was 10 ms off.
    And sparse truth that goes on after the run would be the longer one, to be counted with several frames.
    """
    if len(estimate):
        first, last = estimate.stamps[0] - TOGETHER_NS, estimate.stamps[-1] + TOGETHER_NS
        truth = truth.at((truth.stamps >= first) & (truth.stamps <= last))
    mine, his = associate(estimate, truth)
    if len(truth) > len(estimate) or not len(mine):
        return mine, his
    order = np.lexsort((np.abs(his.stamps - mine.stamps), mine.stamps))
    first = np.concatenate([[True], np.diff(mine.stamps[order]) > 0])
    rows = np.sort(order[first])
    return mine.at(rows), his.at(rows)


def _nearest(longer: Trajectory, shorter: Trajectory) -> tuple[Trajectory, Trajectory]:
    if not len(shorter):
        return longer.at(np.zeros(0, dtype=np.intp)), shorter
    nearest = nearest_rows(longer.stamps, shorter.stamps)
    gap = np.abs(longer.stamps[nearest] - shorter.stamps)
    near = np.flatnonzero(gap <= TOGETHER_NS)
    return longer.at(nearest[near]), shorter.at(near)


def nearest_rows(stamps: NDArray[np.int64], wanted: NDArray[np.int64]) -> NDArray[np.intp]:
    """Row of ``stamps`` (n,), ascending, not empty, nearest to each of ``wanted``; ties take the earlier."""
    after = np.minimum(np.searchsorted(stamps, wanted, side="right"), len(stamps) - 1)
    before = np.maximum(after - 1, 0)
    return np.where(np.abs(stamps[after] - wanted) < np.abs(stamps[before] - wanted), after, before)


def path_length(stamps: NDArray[np.int64], truth: Trajectory) -> float | None:
    """Metres of the true way over poses at ``stamps`` (n,), ascending; None where fewer than two have one."""
    if not len(truth):
        return None
    nearest = nearest_rows(truth.stamps, stamps)
    near = np.abs(truth.stamps[nearest] - stamps) <= TOGETHER_NS
    way = truth.positions[nearest[near]]
    return float(np.linalg.norm(np.diff(way, axis=0), axis=1).sum()) if len(way) > 1 else None


def rows_apart(stamps: NDArray[np.int64], delta_s: float) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows (starts, ends) of ``stamps`` (n,), ascending, that are ``delta_s`` apart, one end for each start.

    To half the median interval, and a quarter of ``delta_s`` at most: where stamps are sparser than that,
    the nearest to a second later may be another second off, or the very row itself.
    """
    nobody = np.zeros(0, dtype=np.intp)
    if len(stamps) < 2:
        return nobody, nobody
    delta = round(delta_s * NS)
    steps = np.diff(stamps)
    steps = steps[steps > 0]  # a true pose may count with two frames
    if not len(steps):
        return nobody, nobody
    slack = min(max(int(np.median(steps)) // 2, 1), delta // 4)
    ends = nearest_rows(stamps, stamps + delta)
    rows = np.arange(len(stamps))
    starts = np.flatnonzero((ends > rows) & (np.abs(stamps[ends] - stamps - delta) <= slack))
    return starts, ends[starts]


def tum_line(stamp_ns: int, pose: Array) -> str:
    """One line of a TUM file: stamp (s, nine decimals, exact), position, quaternion x y z w."""
    numbers = (*pose[:3, 3], *quaternion_from_rotation(pose[:3, :3]))
    return f"{write_seconds(stamp_ns)} " + " ".join(f"{value:.9f}" for value in numbers) + "\n"


def write_tum(path: Path, trajectory: Trajectory) -> None:
    """Writes a TUM file, all of it or nothing. Raises OSError."""
    lines = [tum_line(int(s), p) for s, p in zip(trajectory.stamps, trajectory.poses, strict=True)]
    put_whole(path, "".join(lines).encode("ascii"))


def read_tum(path: Path) -> Trajectory:
    """Reads a TUM file, sorted by stamp; the rules are those of :mod:`prism_edge.sources.tum_poses`.

    Raises EvaluationError naming file and line where a line is no pose, and where there is none at all.
    """
    try:
        rows = read_poses(path)
    except SourceError as error:
        raise EvaluationError(str(error)) from None
    if not rows:
        raise EvaluationError(f"{path}: holds no poses (TUM lines are 'stamp tx ty tz qx qy qz qw')")
    return Trajectory.of(rows)
