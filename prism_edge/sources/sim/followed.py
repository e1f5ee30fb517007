"""A way from a file: the camera goes where somebody's camera went, through a room that is large enough."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from prism_edge.errors import SourceError
from prism_edge.geometry.poses import Array, from_rt, so3_exp, so3_log
from prism_edge.sources.tum_poses import read_poses

WIDEST, HIGHEST = 20.0, 4.0  # m from one end of a way to the other: what a room can hold
EYE_LEVEL = 1.4  # m above the floor: the middle of a way's heights, unless it goes too far up and down
CLEAR = 0.4  # m between a way and floor or ceiling


class Followed:
    """The poses of a TUM file, straight from each to the next, and back again when they are over."""

    def __init__(self, file: Path, speed: float = 0.0) -> None:
        """``speed`` is the mean in m/s, 0 for as it was. World of the file: metres, z up; camera optical.

        Raises SourceError where the file can't be read, has fewer than two moments, or goes farther than a
        room is large.
        """
        rows = dict(read_poses(file))
        stamps = sorted(rows)
        if len(stamps) < 2:
            raise SourceError(f"{file}: a way to follow has poses of two moments and more")
        self._seconds = np.array([(stamp - stamps[0]) * 1e-9 for stamp in stamps])
        self._poses = np.array([rows[stamp] for stamp in stamps])
        places = self._poses[:, :3, 3]
        self.low, self.high = places.min(axis=0), places.max(axis=0)  # (3,) m
        wide, high = float((self.high - self.low)[:2].max()), float(self.high[2] - self.low[2])
        if wide > WIDEST or high > HIGHEST:
            raise SourceError(
                f"{file}: the way is {wide:.1f} m wide and {high:.1f} m high, "
                f"a room holds {WIDEST:g} and {HIGHEST:g}"
            )
        if speed:
            way = float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum())
            if way == 0.0:
                raise SourceError(f"{file}: the camera stands still; speed has no meaning")
            self._seconds *= way / (speed * self.length_s)
        self._shift = np.zeros(3)

    @property
    def length_s(self) -> float:
        """How long once along it takes."""
        return float(self._seconds[-1])

    @property
    def ceiling(self) -> float:
        """How high a room must be, m."""
        return self._middle_height + float(self.high[2] - self.low[2]) / 2 + CLEAR

    @property
    def _middle_height(self) -> float:
        return max(EYE_LEVEL, float(self.high[2] - self.low[2]) / 2 + CLEAR)

    def place(self, middle: Array) -> None:
        """Put the middle of the way above a point (2,) of the floor."""
        self._shift = np.array([*middle, self._middle_height]) - (self.low + self.high) / 2

    def pose(self, seconds: float) -> Array:
        """world_from_camera (4, 4)."""
        lap, there = divmod(seconds, self.length_s)
        there = self.length_s - there if lap % 2 else there
        k = min(max(int(np.searchsorted(self._seconds, there)), 1), len(self._seconds) - 1)
        before, after = self._poses[k - 1], self._poses[k]
        share = (there - self._seconds[k - 1]) / (self._seconds[k] - self._seconds[k - 1])
        turn = so3_exp(share * so3_log(before[:3, :3].T @ after[:3, :3]))
        place = (1 - share) * before[:3, 3] + share * after[:3, 3]
        return from_rt(before[:3, :3] @ turn, place + self._shift)
