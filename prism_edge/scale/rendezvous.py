"""Joins each keyframe to its depth, which arrives apart, later or never."""

from __future__ import annotations

from collections import OrderedDict

from prism_edge.messages import Depth, Keyframe

Key = tuple[int, int]  # epoch, keyframe


class Rendezvous:
    """Keyframes and depths that wait for their other half: at most ``capacity`` of each, oldest out first."""

    def __init__(self, capacity: int = 64) -> None:
        self._capacity = capacity
        self._keyframes: OrderedDict[Key, Keyframe] = OrderedDict()
        self._depths: OrderedDict[Key, Depth] = OrderedDict()
        self.dropped = 0  # that never met their other half

    def add_keyframe(self, keyframe: Keyframe) -> None:
        """Takes a keyframe."""
        self._keyframes[keyframe.epoch, keyframe.id] = keyframe
        while len(self._keyframes) > self._capacity:
            self._keyframes.popitem(last=False)
            self.dropped += 1

    def add_depth(self, depth: Depth) -> None:
        """Takes a keyframe's depth."""
        self._depths[depth.epoch, depth.keyframe] = depth
        while len(self._depths) > self._capacity:
            self._depths.popitem(last=False)
            self.dropped += 1

    def complete(self) -> list[tuple[Keyframe, Depth]]:
        """The pairs that are complete by now, oldest first; each is given once."""
        keys = sorted(self._keyframes.keys() & self._depths.keys())
        return [(self._keyframes.pop(key), self._depths.pop(key)) for key in keys]

    def take_keyframe(self, keyframe: int) -> Keyframe | None:
        """The keyframe alone, for when its depth won't come; None where it isn't here."""
        for key in reversed(self._keyframes):
            if key[1] == keyframe:
                return self._keyframes.pop(key)
        return None
