"""Metres of each part of a map, as the scale process tells them, and of which one the camera is in."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

from prism_edge.backend.map_file import Info
from prism_edge.backend.map_scale import LARGEST_LOG_SCALE, KnownScale
from prism_edge.errors import MapError
from prism_edge.messages import HOME, LARGEST_ID, Scale

MOST = 256  # parts: a camera before what can't be tracked begins one every few seconds
TOLD, JOINED, HERE = "units", "joined_units", "unit_of"  # in a journal


class PartUnits:
    """The log scale (of metres a unit) of each part that has told one.

    A part that a loop has joined to an older one has that one's unit from then on. The tracker, and with it
    the scale process, hears of that later: until then what is told is of a unit that no longer is.
    """

    def __init__(self) -> None:
        self.begin(KnownScale())

    def begin(self, home: KnownScale) -> None:
        """Of another map, of whose first part so much is known."""
        sigma = home.whole_sigma if home.is_known else math.inf
        self._told: dict[int, tuple[float, float]] = {HOME: (home.log_scale, sigma)}
        self._joined: dict[int, int] = {}  # into which
        self._here = HOME

    @property
    def log_scale(self) -> float:
        """Of the part that was spoken of last."""
        return self._told[self._here][0]

    def hear(self, scale: Scale) -> None:
        """What is told of a part is of its own unit; of one that was joined it is out of date."""
        self._here = self._now(scale.part)
        if scale.part == self._here or self._here not in self._told:
            sigma = math.hypot(scale.filter_sigma, scale.bias_sigma, scale.lost_sigma)
            self._told[self._here] = scale.map_log_scale, sigma if math.isfinite(sigma) else math.inf
            while len(self._told) > MOST:
                del self._told[next(part for part in self._told if part not in (HOME, self._here))]

    def go_home(self) -> None:
        """Until somebody speaks of another, the camera is in the map's first part."""
        self._here = self._now(HOME)

    def between(self, part: int, other: int) -> tuple[float, float] | None:
        """Log of a part's unit in another's, and its sigma, by their metres; None where nobody knows.

        One network's bias may be another in another place, so that it counts.
        """
        part, other = self._now(part), self._now(other)
        if part == other or part not in self._told or other not in self._told:
            return None
        (mine, my_sigma), (its, its_sigma) = self._told[part], self._told[other]
        sigma = math.hypot(my_sigma, its_sigma)
        return (mine - its, sigma) if math.isfinite(sigma) else None

    def join(self, part: int, other: int, log_unit: float) -> None:
        """The newer of two parts has the older one's unit, in which its own was exp(``log_unit``)."""
        older, newer = sorted((self._now(part), self._now(other)))
        if older == newer:
            return
        _, sigma = self._told.get(older, (0.0, math.inf))
        if newer in self._told and not math.isfinite(sigma):
            log_scale, sigma = self._told[newer]
            self._told[older] = log_scale - log_unit, sigma
        self._joined[newer] = older
        self._here = self._now(self._here)

    def info(self, parts: Iterable[int | None]) -> Info:
        """For a journal of a map that has these parts, so that another life goes on with their metres."""
        there = {part for part in parts if part is not None}
        kept = {HOME, self._here, *map(self._now, there)} & self._told.keys()
        rows = ((part, *self._told[part]) for part in sorted(kept))
        told = [[part, log_scale, sigma if math.isfinite(sigma) else None] for part, log_scale, sigma in rows]
        joined = [[part, self._now(part)] for part in sorted(there & self._joined.keys())]
        return {TOLD: told, JOINED: joined, HERE: self._here}

    def take(self, info: Info) -> None:
        """What a journal says; nothing where an earlier build wrote it. Raises MapError for what can't be."""
        if TOLD not in info:
            return
        told: Any = info[TOLD]
        joined: Any = info.get(JOINED)
        here: Any = info.get(HERE)
        if not _are_told(told) or not _are_joined(joined):
            raise MapError("the map's units are none of its parts")
        known = {part: (float(log_scale), math.inf if s is None else float(s)) for part, log_scale, s in told}
        if type(here) is not int or here not in known:
            raise MapError("the map's units are not of the part that was spoken of")
        self._told, self._joined, self._here = {**self._told, **known}, dict(joined), here

    def _now(self, part: int) -> int:
        while part in self._joined:
            part = self._joined[part]
        return part


def _are_told(rows: Any) -> bool:
    """Whether each is a part, the log scale of its unit, and the sigma of that or None."""
    return _are_rows(rows, (int, float | int, float | int | None)) and all(
        HOME <= part < LARGEST_ID and abs(log_scale) < LARGEST_LOG_SCALE and (sigma is None or sigma >= 0.0)
        for part, log_scale, sigma in rows
    )


def _are_joined(rows: Any) -> bool:
    """Whether each is a part and an older one."""
    return _are_rows(rows, (int, int)) and all(HOME <= older < newer < LARGEST_ID for newer, older in rows)


def _are_rows(rows: Any, kinds: tuple[Any, ...]) -> bool:
    return isinstance(rows, list) and all(
        isinstance(row, list)
        and len(row) == len(kinds)
        and all(isinstance(v, kind) and not isinstance(v, bool) for v, kind in zip(row, kinds, strict=True))
        for row in rows
    )
