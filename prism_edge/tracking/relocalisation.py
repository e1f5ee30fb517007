"""Finding a lost camera anywhere in the map, a few keyframes with each frame.

Which keyframes first is the depth network's word: it sees the lost camera's picture (a *probe*) and its
descriptor ranks all keyframes. Beside what it names, all have their turn, the newest first: it is asked again
and again, and may be wrong each time. A pose counts once a second frame confirms it: what was published
wrongly can't be taken back. And where much less is found than usually is from there, the map is gone through
for a place that more agrees with: along a corridor one door is like the next.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from prism_edge.geometry.poses import inverse, rotation_angle
from prism_edge.messages import F32
from prism_edge.tracking.frame_tracking import FrameTracker, TrackedFrame
from prism_edge.tracking.local_map import LocalMap
from prism_edge.tracking.place_index import PlaceIndex
from prism_edge.tracking.recovery import placed_at
from prism_edge.tracking.view import View

TRIES = 2  # keyframes tried with a frame; each takes some 10 ms
RANKED = 8  # keyframes of the network's ranking that are tried, one with each frame
NEAR = 3  # covisible keyframes beside the newest that are tried first
CERTAIN = 2.0  # times the matches that tracking needs
SAME_ANGLE, SAME_SHIFT = np.radians(10.0), 0.2  # a frame later, at 30 Hz; of the median depth
CONVINCING = 0.6  # of what is usually found from there: that place, and no other
BETTER = 1.1  # times the matches, for another place to be taken in place of a doubtful one
CONSIDERED_NS = 500_000_000  # so long is another place looked for, unless all keyframes have had their turn
FRAME_NS, MOST_FRAMES = 33_333_333, 4.0  # slower cameras, and dropped frames, leave more time to move


class Relocaliser:
    """Knows what keyframes look like, and where a lost camera was looked for already."""

    def __init__(self, seed: int = 0) -> None:
        self._seed = seed
        self.index = PlaceIndex()
        self._named: deque[int] = deque()  # by the network, best first
        self._round: deque[int] = deque()
        self._tentative: TrackedFrame | None = None
        self._looked_ns = self._since_ns = 0  # last; since there was a doubtful place
        self._tried: set[int] = set()  # keyframes, since then

    def begin(self) -> None:
        """Tracking has just been lost."""
        self._named.clear()
        self._round.clear()
        self._tentative = None

    def add_place(self, keyframe: int, descriptor: F32, network: str = "") -> None:
        """Note what the network says of a keyframe."""
        self.index.add(keyframe, descriptor, network)

    def forget(self, keyframe: int) -> None:
        """A keyframe has left the map."""
        self.index.remove(keyframe)

    def heard(self, world: LocalMap, descriptor: F32, network: str = "") -> None:
        """The network's word on the lost camera's picture: what it names is tried next."""
        named: list[int] = []
        covered: set[int] = set()
        for k, _ in self.index.rank(descriptor, world.keyframes, network):
            if k not in covered:
                named.append(k)
                covered.update(world.keyframes[k].neighbours[:2])
            if len(named) == RANKED:
                break
        self._named = deque(named)

    def attempt(
        self,
        world: LocalMap,
        frames: FrameTracker,
        view: View,
        last: TrackedFrame | None,
        least: int,
    ) -> TrackedFrame | None:
        """The frame's place in the map once two frames agree on it; None so far.

        ``last`` is the last tracked frame, ``least`` the matches that tracking needs.
        """
        enough, stamp_ns = int(CERTAIN * least), view.taken_ns
        passed = min(max((stamp_ns - self._looked_ns) / FRAME_NS, 1.0), MOST_FRAMES)
        self._looked_ns = stamp_ns
        doubtful, tentative, self._tentative = False, self._tentative, None
        best: TrackedFrame | None = None
        if tentative is not None:
            best = self._placed(world, frames, view, tentative, enough)
            if best is not None and _near(world, tentative, best, passed):
                if self._convinces(world, frames, best):
                    return best
                doubtful = True
            else:
                best = None
        if not doubtful:
            self._tried, self._since_ns = set(), stamp_ns
        if best is None and last is not None:  # a hand before the lens: it may not have moved
            best = self._placed(world, frames, view, last, enough)
            if best is not None and self._convinces(world, frames, best):
                self._tentative = best
                return None
        for keyframe in self._next(world):
            self._tried.add(keyframe)
            there = world.keyframes[keyframe]
            frame = placed_at(world, frames, view, there, least, self._seed)
            least_matched = enough if best is None else max(enough, BETTER * best.matched)
            if frame is not None and frame.matched >= least_matched:
                best, doubtful = frame, False
        self._tentative = best
        all_tried = self._tried.issuperset(world.keyframes)
        considered = all_tried or stamp_ns - self._since_ns >= CONSIDERED_NS
        if best is None or not (doubtful and considered):
            return None
        _look_about(world, frames, best)
        return best

    @staticmethod
    def _convinces(world: LocalMap, frames: FrameTracker, frame: TrackedFrame) -> bool:
        return frame.matched >= CONVINCING * frames.usually_found(world, frame)

    def _placed(
        self,
        world: LocalMap,
        frames: FrameTracker,
        view: View,
        before: TrackedFrame,
        enough: int,
    ) -> TrackedFrame | None:
        _look_about(world, frames, before)
        frame = frames.track(world, view, before.world_from_camera, before, enough // 2)
        return frame if frame is not None and frame.matched >= enough else None

    def _next(self, world: LocalMap) -> list[int]:
        """The next that was named, and the next of the round; a new round once all have had their turn."""
        self._round = self._round or self._new_round(world)
        chosen: list[int] = []
        for waiting, most in ((self._named, TRIES - 1), (self._round, TRIES)):
            while waiting and len(chosen) < most:
                k = waiting.popleft()
                if k in world.keyframes and k not in chosen:
                    chosen.append(k)
        return chosen

    @staticmethod
    def _new_round(world: LocalMap) -> deque[int]:
        """The newest and those beside it, then all the others, far ones first between near ones."""
        if not world.keyframes:
            return deque()
        newest = world.newest()
        first = [newest.id, *(k.id for k in world.covisible(newest, NEAR))]
        rest = [k for k in sorted(world.keyframes) if k not in first]
        spread = [k for start in range(4) for k in rest[start::4]]
        return deque([*first, *spread])


def _look_about(world: LocalMap, frames: FrameTracker, frame: TrackedFrame) -> None:
    frames.refresh_local_map(world, frame.points[frame.points >= 0])


def _near(world: LocalMap, before: TrackedFrame, after: TrackedFrame, frames: float) -> bool:
    """Whether two places are within the motion of so many ``frames`` (at 30 Hz) of each other."""
    step = inverse(before.world_from_camera) @ after.world_from_camera
    ids = after.points[after.points >= 0]
    places = world.points.position[world.points.rows(ids)]
    pose = after.world_from_camera
    depth = float(np.median((places - pose[:3, 3]) @ pose[:3, 2])) if len(ids) else 1.0
    return (
        rotation_angle(step[:3, :3]) < frames * SAME_ANGLE
        and float(np.linalg.norm(step[:3, 3])) < frames * SAME_SHIFT * max(depth, 1e-9)
    )
