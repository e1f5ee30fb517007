"""Metres of each part of a map, as the scale process tells them, and of which one the camera is in."""

from __future__ import annotations

import math

from prism_edge.backend.map_scale import KnownScale
from prism_edge.messages import HOME, Scale


class PartUnits:
    """The log scale (of metres a unit) of each part that has told one.

    A part that a loop has joined to an older one has that one's unit from then on. The tracker, and with it
    the scale process, hears of that later: until then what is told is of a unit that no longer is.
    """

    def __init__(self, home: float = 0.0, sigma: float = math.inf) -> None:
        """``home`` is the log scale of the map's first part, as well known as ``sigma`` says."""
        self._told: dict[int, tuple[float, float]] = {HOME: (home, sigma)}
        self._joined: dict[int, int] = {}  # into which
        self._here = HOME

    @classmethod
    def of(cls, home: KnownScale) -> PartUnits:
        """Of a map that was there before."""
        return cls(home.log_scale, home.whole_sigma if home.is_known else math.inf)

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
        if older not in self._told and newer in self._told:
            log_scale, sigma = self._told[newer]
            self._told[older] = log_scale - log_unit, sigma
        self._joined[newer] = older
        self._here = self._now(self._here)

    def _now(self, part: int) -> int:
        while part in self._joined:
            part = self._joined[part]
        return part
