"""Map points as columns of arrays, addressed by permanent ids; rows stay sorted by id."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from prism_edge.geometry.poses import Array
from prism_edge.messages import beyond

Index = NDArray[np.intp]
Ids = NDArray[np.int64]

TRIANGULATED_DEG = 1.0  # of parallax, from which on a network has no say in where a point is
LEAST_SLOTS = 1 << 14
SLOTS_A_ROW = 4  # so few of the ids that are far apart share a slot, and so need a search

# name: (dtype, width); width 0 is a plain column
_COLUMNS: dict[str, tuple[type, int]] = {
    "ids": (np.int64, 0),
    "position": (np.float64, 3),  # world, map units
    "descriptor": (np.uint64, 4),  # of the newest keyframe that saw it
    "direction": (np.float64, 3),  # unit, from the point to the camera that last saw it
    "distance": (np.float64, 0),  # to that camera
    "octave": (np.int64, 0),  # it was seen at there
    "log_depth_sigma": (np.float64, 0),  # relative error along the ray of its reference keyframe
    "parallax_deg": (np.float64, 0),  # widest angle it was triangulated at; 0: only seeded from depth
    "reference": (np.int64, 0),  # keyframe that created it
    "reference_keypoint": (np.int64, 0),
    "born_ns": (np.int64, 0),  # stamp of that keyframe
    "observations": (np.int64, 0),  # keyframes that see it
    "visible": (np.int64, 0),  # frames that should have seen it
    "found": (np.int64, 0),  # frames that did
    "weight": (np.float64, 0),  # how far it is trusted to be static and well placed, 0..1
    "alive": (np.bool_, 0),
}


class PointTable:
    """Growable columns; dead rows are squeezed out when they are the majority."""

    ids: Ids
    position: Array
    descriptor: NDArray[np.uint64]
    direction: Array
    distance: Array
    octave: NDArray[np.int64]
    log_depth_sigma: Array
    parallax_deg: Array
    reference: Ids
    reference_keypoint: NDArray[np.int64]
    born_ns: NDArray[np.int64]
    observations: NDArray[np.int64]
    visible: NDArray[np.int64]
    found: NDArray[np.int64]
    weight: Array
    alive: NDArray[np.bool_]

    def __init__(self) -> None:
        self._next_id = 0
        self._size = 0
        self._slots: Index = np.zeros(0, np.intp)  # row of each id, by the id's lowest bits
        self._mask = 0
        self._shared = False  # whether some ids have a slot in common; then the newest of them has it
        self._storage = {name: self._column(name, 4096) for name in _COLUMNS}
        self._expose()

    @staticmethod
    def _column(name: str, capacity: int) -> NDArray[np.generic]:
        dtype, width = _COLUMNS[name]
        return np.zeros((capacity, width) if width else capacity, dtype)

    def _expose(self) -> None:
        for name, column in self._storage.items():
            setattr(self, name, column[: self._size])

    def __len__(self) -> int:
        return self._size

    def add(self, count: int, **columns: object) -> Ids:
        """Append ``count`` points with the given column values; returns their new ids."""
        ids = np.arange(self._next_id, self._next_id + count)
        self._append(ids, columns)
        return ids

    def restore(self, ids: Ids, **columns: object) -> None:
        """Fill an empty table with points that have their numbers already, in ascending order."""
        assert self._size == 0
        self._append(ids, columns)

    def leave_room(self, first: int) -> None:
        """Number what comes from ``first`` on at least, and past what the last owner may have given out."""
        self._next_id = max(first, beyond(self._next_id - 1))

    def _append(self, ids: Ids, columns: dict[str, object]) -> None:
        count = len(ids)
        need = self._size + count
        capacity = len(self._storage["ids"])
        if need > capacity:
            for name, column in self._storage.items():
                grown = self._column(name, max(need, 2 * capacity))
                grown[: self._size] = column[: self._size]
                self._storage[name] = grown
        rows = slice(self._size, need)
        self._next_id = max(self._next_id, int(ids[-1]) + 1) if count else self._next_id
        defaults = {"ids": ids, "alive": True, "weight": 1.0, "visible": 1, "found": 1}
        for name, value in (defaults | columns).items():
            self._storage[name][rows] = value  # type: ignore[assignment]
        self._size = need
        self._expose()
        self._index()

    def rows(self, ids: Ids) -> Index:
        """Row of each id; the ids must be present, dead or alive."""
        rows = self._slots.take(ids & self._mask)
        if self._shared:
            elsewhere = self.ids[rows] != ids
            if elsewhere.any():
                rows[elsewhere] = np.searchsorted(self.ids, ids[elsewhere])
        return rows

    def known(self, ids: Ids) -> NDArray[np.bool_]:
        """Which ids are present and alive."""
        if self._size == 0:
            return np.zeros(len(ids), bool)
        rows = self._slots.take(ids & self._mask)
        if self._shared:
            elsewhere = self.ids[rows] != ids
            rows[elsewhere] = np.minimum(np.searchsorted(self.ids, ids[elsewhere]), self._size - 1)
        return (self.ids.take(rows) == ids) & self.alive.take(rows)

    def live_rows(self, ids: Ids) -> Index:
        """Rows of those among the ids that are present and alive."""
        if self._shared or self._size == 0:
            return self.rows(ids[self.known(ids)])
        rows = self._slots.take(ids & self._mask)
        return rows.compress((self.ids.take(rows) == ids) & self.alive.take(rows))

    def _index(self) -> None:
        """Rebuild the direct index, a search's fivefold speed.

        It is as large as the table asks for, however many ids were ever given out: a camera that runs for
        weeks must not pay for them.
        """
        count = max(LEAST_SLOTS, 1 << int(SLOTS_A_ROW * self._size - 1).bit_length())
        self._slots, self._mask = np.zeros(count, np.intp), count - 1
        rows = np.arange(self._size)
        slots = self.ids & self._mask
        self._slots[slots] = rows
        self._shared = bool((self._slots[slots] != rows).any())

    def squeeze(self) -> None:
        """Forget dead rows once they are more than half of a table worth the work."""
        if self._size < 4096 or self.alive.sum() * 2 > self._size:
            return
        keep = np.flatnonzero(self.alive)
        for column in self._storage.values():
            column[: len(keep)] = column[keep]
            column[len(keep) : self._size] = 0  # rows to come begin as empty as the first ones did
        self._size = len(keep)
        self._expose()
        self._index()
