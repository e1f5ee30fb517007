"""Separate parts of one map: what was mapped while lost does not hang together with the rest until merged.

All parts share keyframe and point numbers, and the world's frame as far as arithmetic goes; but where a part
lies in it is unknown until the backend recognises a place of another part and moves the newer one there.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection

from prism_edge.geometry.poses import Array
from prism_edge.messages import HOME
from prism_edge.tracking.local_map import LocalKeyframe, LocalMap
from prism_edge.tracking.point_table import Ids

CULLED = 256  # keyframes whose part is still known: a loop may be on its way that one of them closed


class Parts:
    """Which part each keyframe belongs to, and which one the camera is tracked in."""

    def __init__(self) -> None:
        self.current = HOME
        self._of: dict[int, int] = {}  # keyframes that are not at home
        self._culled: dict[int, int] = {}  # the same of the last that have left the map
        self._joined: list[tuple[int, int, float, float]] = []  # what nobody has been told of

    @classmethod
    def given(cls, of: dict[int, int]) -> Parts:
        """Parts that there are already: the part of each keyframe that is not at home."""
        parts = cls()
        parts._of = dict(of)
        return parts

    @property
    def at_home(self) -> bool:
        """Whether poses are known in the map."""
        return self.current == HOME

    def of(self, keyframe: int) -> int:
        """The part of a keyframe."""
        return self._of.get(keyframe, HOME)

    def add(self, keyframe: int) -> None:
        """A new keyframe belongs to the part the camera is tracked in."""
        if self.current != HOME:
            self._of[keyframe] = self.current

    def begin(self, keyframe: int) -> None:
        """A new part begins with a keyframe."""
        self.current = keyframe
        self.add(keyframe)

    def forget(self, keyframe: int) -> None:
        """A keyframe has left the map."""
        part = self._of.pop(keyframe, HOME)
        if part != HOME:
            self._culled[keyframe] = part
        if len(self._culled) > CULLED:
            del self._culled[next(iter(self._culled))]

    def enter(self, world: LocalMap, points: Ids) -> None:
        """The camera was found by these points: their part is where it is."""
        votes: dict[int, int] = {}
        for keyframe, count in world.votes(points).items():
            votes[self.of(keyframe)] = votes.get(self.of(keyframe), 0) + count
        if votes:
            self.current = max(sorted(votes), key=lambda part: votes[part])

    def of_both(self, one: int, other: int) -> tuple[int, int]:
        """The parts of two keyframes, which may have left the map lately: the older part, the newer."""
        old, new = sorted(self._of.get(end, self._culled.get(end, HOME)) for end in (one, other))
        return old, new

    def merge(self, one: int, other: int, units: Array | None = None) -> bool:
        """Two keyframes turned out to see one place: the newer part becomes of the older. False: it was.

        ``units`` (2,), where they are known: log of the newer one's unit in the older one's, and its sigma.
        """
        old, new = self.of_both(one, other)
        if old == new:
            return False
        if units is not None and len(units):
            self._joined.append((new, old, *units.tolist()))
        for of in (self._of, self._culled):
            for keyframe in [k for k, part in of.items() if part == new]:
                if old == HOME:
                    del of[keyframe]
                else:
                    of[keyframe] = old
        if self.current == new:
            self.current = old
        return True

    def take_joined(self) -> list[tuple[int, int, float, float]]:
        """Parts that were merged since this was last asked, each newer, older and their ``units``."""
        joined, self._joined = self._joined, []
        return joined

    def small(self, most: int) -> set[int]:
        """Keyframes of parts that have no more than ``most``: not of home, nor of where the camera is."""
        sizes = Counter(self._of.values())
        return {k for k, part in self._of.items() if sizes[part] <= most and part != self.current}

    def newest(self, world: LocalMap) -> LocalKeyframe:
        """The latest keyframe of the part that the camera is in; of the map where that has none left."""
        mine = self._mine(world)
        return world.keyframes[max(mine)] if mine else world.newest()

    def size(self, world: LocalMap) -> int:
        """Keyframes in the part that the camera is in."""
        return len(self._mine(world))

    def _mine(self, world: LocalMap) -> Collection[int]:
        """The numbers of those; each frame asks several times, so they are not looked at one by one."""
        if self.current == HOME:
            return world.keyframes.keys() - self._of.keys() if self._of else world.keyframes
        return [k for k, part in self._of.items() if part == self.current and k in world.keyframes]
