"""How far the map may have drifted: a random walk with the way and the turning, undone where it is known.

Between two places that share points the map's error grows like a random walk. Its variance grows by
``drift_per_sqrt_m``^2 for each metre, and by what a local map is out of shape: a second's motion is off by a
share of its way, and the next second's by another. That share is ``drift_of_motion`` where the points that
carry the frame were placed under a degree of parallax, less in proportion where under more, and beside it
what keyframes show of the map's scale here. Of rotation it grows by ``drift_per_sqrt_rad``^2, by parallax as
well, for each radian turned and ``turn_per_sqrt_m``^2 for each metre; and for what a way across the view is
off by a turn makes up, the more so the narrower the view is (baseline.py), so that what is seen stays where
it is in the image. The whole walk is what `odom` has. In the map a keyframe that sees known points drifted
little more than its neighbours: its drift is that of the shortest way through keyframes that share points,
from the first one. Each step counts under the lesser parallax of its two ends, of each as it was made: points
that are seen better since leave it where it is.

Way and turning are summed from frame to frame, but from one place that the camera has clearly left to the
next to no more than MOST_DETOUR times what lies between: a camera that stands trembles, and goes nowhere.
"""

from __future__ import annotations

import heapq
import math
from dataclasses import dataclass

import numpy as np

from prism_edge.config import CovarianceConfig
from prism_edge.geometry.poses import Array, inverse, rotation_angle
from prism_edge.messages import MapUpdate
from prism_edge.tracking.baseline import LEAST_PARALLAX_DEG
from prism_edge.tracking.frame_result import FrameResult
from prism_edge.tracking.keyframe_decision import MOVED_ANGLE, MOVED_BASELINE
from prism_edge.tracking.local_map import LocalKeyframe, LocalMap

Front = list[tuple[float, int]]  # a heap of keyframes and their variances (m^2)

FORGET_ABOVE = 2  # times as many keyframes remembered as there are
COHERENT_S = 1.0  # for so long the local map is off by the same share; speed is averaged over as long
COHERENT_M = 1.0  # and, between two places, at least over so much of the way, however slow the camera is now
LONGEST_S = 3.0  # between two frames: longer than that nothing was seen; slow cameras take an image a second
MOST_DETOUR = 4.0  # a moving camera has 1.1 to 2.5: the walk's numbers were fitted with that
# Of a camera that nobody sees: one that is covered or carried off often stood before, and is then carried.
UNSEEN_M_S, UNSEEN_RAD_S = 0.5, 0.5


@dataclass(frozen=True)
class Walk:
    """Variances: m^2 and rad^2, the same along and about each axis."""

    metres2: float = 0.0
    radians2: float = 0.0

    def __add__(self, other: Walk) -> Walk:
        return Walk(self.metres2 + other.metres2, self.radians2 + other.radians2)

    def sigmas(self) -> tuple[float, float]:
        """Standard deviations, m and rad."""
        return math.sqrt(self.metres2), math.sqrt(self.radians2)

    def covariance(self) -> Array:
        """(6, 6), translation first; alike in all axes, so the same in every frame."""
        return np.diag([self.metres2] * 3 + [self.radians2] * 3)

    def grown(self, step: Walk, most: Walk) -> Walk:
        """This and a step, but not beyond ``most``; never less than this."""
        metres2 = max(self.metres2, min(self.metres2 + step.metres2, most.metres2))
        return Walk(metres2, max(self.radians2, min(self.radians2 + step.radians2, most.radians2)))


NO_DRIFT = Walk()


class Drift:
    """Follows one camera: ``total`` is the whole walk, ``here`` what of it the last frame has in the map.

    ``travelled`` is its path length in map units, or what it is set to and the path since.
    """

    def __init__(self, config: CovarianceConfig) -> None:
        self._config = config
        self._speed = self._turn = 0.0  # metres and radians a second
        self._lately = np.zeros(3)  # seconds, metres and radians gone; what is long ago counts for little
        self._stamp_ns: int | None = None
        self.local_sigma = 0.0  # of the log scale here about the published one, as last heard
        self._parallax_deg = self._shift_as_turn = 1.0  # of what the last frame saw
        self._depth = 0.0  # of the scene there, map units; 0: not known
        self.total = self.here = NO_DRIFT
        self._travelled = self._travelled_at_anchor = 0.0
        self._at_anchor, self._since_anchor = NO_DRIFT, np.eye(4)
        self._keyframes: dict[int, Walk] = {}
        self._parallaxes: dict[int, float] = {}  # degrees, of what each saw as it was made
        self._at_beginning: Walk | None = None  # the walk when the map began; None: it was there before

    @property
    def travelled(self) -> float:
        return self._travelled

    @travelled.setter
    def travelled(self, way: float) -> None:
        self._travelled = way
        self._set_anchor()

    def forget(self) -> None:
        """Another map, whose keyframes have numbers of this one's; `odom` goes on."""
        self._keyframes, self._parallaxes, self.local_sigma = {}, {}, 0.0
        self._at_beginning = None

    def miss(self, seconds: float) -> None:
        """Of so long a way before the next frame nothing is known, neither how far it went nor where to."""
        metres = max(self._speed, UNSEEN_M_S) * seconds
        radians = min(max(self._turn, UNSEEN_RAD_S) * seconds, math.pi)
        self.total += Walk(metres**2, radians**2)
        self._set_anchor()
        self._stamp_ns = None

    def advance(
        self,
        before: Array | None,
        result: FrameResult,
        log_scale: float,
        stamp_ns: int | None = None,
        depth: float = 0.0,
    ) -> None:
        """A frame has been tracked; ``before`` is where the present map has the one before it.

        ``depth`` is the scene's, in map units: beside it the camera has clearly moved
        or has not, and what a way is off by is an angle.
        """
        self._parallax_deg, self._shift_as_turn = result.parallax_deg, result.shift_as_turn
        self._depth = depth
        if result.world_from_camera is not None and before is not None:
            motion = inverse(before) @ result.world_from_camera
            self._pace(motion, log_scale, stamp_ns)
            self._go(motion, log_scale, depth)
        else:  # another map may have begun, with another unit
            self._set_anchor()
        self._stamp_ns = stamp_ns
        keyframe = self._keyframes.get(result.reference)
        if keyframe is None and result.world_from_camera is not None:
            # Of an earlier life, as for _until(): else it would grow with `odom`'s walk.
            there = result.world_from_camera @ inverse(result.reference_from_camera)
            keyframe = self._of(there, log_scale)
        keyframe = self.total if keyframe is None else keyframe
        under = min(self._parallaxes.get(result.reference, self._parallax_deg), self._parallax_deg)
        step = self._of(result.reference_from_camera, log_scale, under)
        self.here = self._at_most_walked(keyframe + step)

    def add_keyframe(self, world: LocalMap, keyframe: LocalKeyframe, log_scale: float) -> None:
        """A keyframe has been made, and its neighbours are known; the first of all has no drift.

        A map that takes another's place begins where the camera was in that, and as far off.
        """
        if len(world.keyframes) == 1:
            elsewhere = not np.allclose(keyframe.world_from_camera, np.eye(4))
            goes_on = elsewhere and self._at_beginning is not None
            self._keyframes = {keyframe.id: self.here if goes_on else NO_DRIFT}
            self._parallaxes = {keyframe.id: LEAST_PARALLAX_DEG}
            self._at_beginning = self._at_beginning if goes_on else self.total
            return
        near = _near(world, keyframe)
        # What begins a part was placed by one depth image, whatever the last frame before it had seen.
        self._parallaxes[keyframe.id] = self._parallax_deg if near else LEAST_PARALLAX_DEG
        between = self._between(keyframe, near, log_scale)
        ways = [self._until(k, log_scale) + way for k, way in zip(near, between, strict=True)]
        self._keyframes[keyframe.id] = self._at_most_walked(_least(ways or [self.total]))
        if len(self._keyframes) > FORGET_ABOVE * len(world.keyframes) + 10:
            self._keyframes = {k: walk for k, walk in self._keyframes.items() if k in world.keyframes}
            self._parallaxes = {k: deg for k, deg in self._parallaxes.items() if k in world.keyframes}

    def _at_most_walked(self, drift: Walk) -> Walk:
        """A drift in the map is no more than what `odom` has walked since the map began."""
        began, total = self._at_beginning, self.total
        if began is None:
            return drift
        return _least([drift, Walk(total.metres2 - began.metres2, total.radians2 - began.radians2)])

    def close(self, world: LocalMap, update: MapUpdate, log_scale: float) -> None:
        """A loop has joined two keyframes: what is around them is as sure as the surer of the two."""
        query, candidate = world.keyframes.get(update.loop_query), world.keyframes.get(update.loop_candidate)
        if query is None or candidate is None:
            return
        front: Front = []
        beside = _beside(world)
        self._spread(candidate, [query], log_scale, front)
        self._spread(query, [candidate], log_scale, front)
        while front:  # the surest first: no keyframe's surroundings are gone through twice
            metres2, number = heapq.heappop(front)
            surer = world.keyframes[number]
            if metres2 <= self._keyframes[number].metres2:  # else it has been made surer since
                near = [world.keyframes[k] for k in sorted(beside[number])]
                self._spread(surer, near, log_scale, front)

    def _spread(
        self, surer: LocalKeyframe, near: list[LocalKeyframe], log_scale: float, front: Front
    ) -> None:
        """Make keyframes as sure as the way from a surer one allows; what that changes joins the heap."""
        here = self._until(surer, log_scale)
        for other, way in zip(near, self._between(surer, near, log_scale), strict=True):
            known, found = self._until(other, log_scale), here + way
            if found.metres2 < known.metres2 * (1.0 - 1e-6):
                self._keyframes[other.id] = _least([found, known])
                heapq.heappush(front, (found.metres2, other.id))

    def _of(self, motion: Array, log_scale: float, parallax_deg: float | None = None) -> Walk:
        """What is added between two places that differ by ``motion`` (4, 4), map units."""
        way, across = (float(np.linalg.norm(motion[:n, 3])) for n in (3, 2))
        return self._walk(way, across, rotation_angle(motion[:3, :3]), log_scale, parallax_deg)

    def _walk(
        self, way: float, across: float, angle: float, log_scale: float, parallax_deg: float | None = None
    ) -> Walk:
        """What is added over a way, ``across`` of it across the view (map units), and a turn (rad).

        Under the last frame's parallax if none is given.
        """
        c, metres, under = self._config, math.exp(log_scale) * way, parallax_deg or self._parallax_deg
        share2 = (c.drift_of_motion / under) ** 2 + self.local_sigma**2
        off_by2 = share2 * max(COHERENT_S * self._speed, min(metres, COHERENT_M)) * metres
        radians2 = (c.drift_per_sqrt_rad / under) ** 2 * angle + c.turn_per_sqrt_m**2 * metres
        if metres > 0.0 and self._depth > 0.0:
            depth = math.exp(log_scale) * self._depth
            radians2 += off_by2 * (c.turn_of_motion * self._shift_as_turn * across / way / depth) ** 2
        return Walk(c.drift_per_sqrt_m**2 * metres + off_by2, radians2)

    def _go(self, motion: Array, log_scale: float, depth: float) -> None:
        """Take a frame's motion into the way."""
        self._since_anchor = self._since_anchor @ motion
        step, way = (float(np.linalg.norm(m[:3, 3])) for m in (motion, self._since_anchor))
        angle = rotation_angle(self._since_anchor[:3, :3])
        clear = MOVED_BASELINE * depth
        most, most_angle = MOST_DETOUR * max(way, clear), MOST_DETOUR * max(angle, MOVED_ANGLE)
        bound = self._at_anchor + self._walk(most, most, most_angle, log_scale)
        self.total = self.total.grown(self._of(motion, log_scale), bound)
        self._travelled = max(self._travelled, min(self._travelled + step, self._travelled_at_anchor + most))
        if way > clear or angle > MOVED_ANGLE:
            self._set_anchor()

    def _set_anchor(self) -> None:
        self._at_anchor, self._travelled_at_anchor = self.total, self._travelled
        self._since_anchor = np.eye(4)

    def _pace(self, motion: Array, log_scale: float, stamp_ns: int | None) -> None:
        """Take a frame's motion into the speed."""
        elapsed_s = 0.0
        if stamp_ns is not None and self._stamp_ns is not None:
            elapsed_s = (stamp_ns - self._stamp_ns) * 1e-9
        if 0.0 < elapsed_s < LONGEST_S:
            metres = math.exp(log_scale) * float(np.linalg.norm(motion[:3, 3]))
            step = np.array([elapsed_s, metres, rotation_angle(motion[:3, :3])])
            # Sums, not a mean of speeds: of two images that came together one has none, and one a leap's.
            self._lately = math.exp(-elapsed_s / COHERENT_S) * self._lately + step
            self._speed, self._turn = (self._lately[1:] / self._lately[0]).tolist()

    def _until(self, keyframe: LocalKeyframe, log_scale: float) -> Walk:
        """Of a keyframe; of one that an earlier life made, as the crow flies from the map's beginning."""
        known = self._keyframes.get(keyframe.id)
        return self._of(keyframe.world_from_camera, log_scale) if known is None else known

    def _between(self, first: LocalKeyframe, others: list[LocalKeyframe], log_scale: float) -> list[Walk]:
        """What is added on the straight way from one keyframe to each of some others."""
        if not others:
            return []
        here, there = first.world_from_camera, np.array([k.world_from_camera for k in others])
        offsets = (there[:, :3, 3] - here[:3, 3]) @ here[:3, :3]
        ways, across = (np.linalg.norm(offsets[:, :n], axis=1) for n in (3, 2))
        # Two rotations' matrices differ by sqrt(8) sin(angle / 2).
        chords = np.linalg.norm(there[:, :3, :3] - here[:3, :3], axis=(1, 2)) / math.sqrt(8.0)
        turns = 2.0 * np.arcsin(np.minimum(chords, 1.0))
        mine = self._parallaxes.get(first.id, self._parallax_deg)
        under = [min(mine, self._parallaxes.get(k.id, mine)) for k in others]
        each = zip(ways.tolist(), across.tolist(), turns.tolist(), under, strict=True)
        return [self._walk(way, aside, turn, log_scale, deg) for way, aside, turn, deg in each]


def _near(world: LocalMap, keyframe: LocalKeyframe) -> list[LocalKeyframe]:
    return [world.keyframes[k] for k in keyframe.neighbours if k in world.keyframes]


def _beside(world: LocalMap) -> dict[int, set[int]]:
    """Keyframes that see the same, both ways: a list of ten comes to hold newer ones alone."""
    beside: dict[int, set[int]] = {k: set() for k in world.keyframes}
    for k, keyframe in world.keyframes.items():
        for other in keyframe.neighbours:
            if other in beside:
                beside[k].add(other)
                beside[other].add(k)
    return beside


def _least(walks: list[Walk]) -> Walk:
    return Walk(min(w.metres2 for w in walks), min(w.radians2 for w in walks))
