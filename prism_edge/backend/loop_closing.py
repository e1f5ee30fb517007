"""Loops from end to end: found, verified, spread over the map, their double points made one, all adjusted."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from prism_edge.backend import global_adjustment, pose_graph
from prism_edge.backend.connectivity import Way, covisibility, joined_pieces, reachable, ways, with_bridges
from prism_edge.backend.free_points import explained
from prism_edge.backend.global_adjustment import GlobalAdjustment
from prism_edge.backend.global_map import GlobalKeyframe, GlobalMap
from prism_edge.backend.lens import Lens, LensWatch, common, radial
from prism_edge.backend.loops import (
    MIN_SCALED,
    Loop,
    Surroundings,
    median_depth,
    plausible,
    verify,
    with_free_points,
)
from prism_edge.backend.places import candidates, half_known
from prism_edge.config import BackendConfig
from prism_edge.errors import first_line
from prism_edge.geometry.poses import Array, inverse, rotation_angle, scaled
from prism_edge.messages import F32
from prism_edge.tracking.place_index import PlaceIndex
from prism_edge.tracking.point_table import TRIANGULATED_DEG

log = logging.getLogger("prism_edge.backend")

CANDIDATES, HALF_KNOWN = 5, 2  # verified for each keyframe at most: look-alikes, and places half known
AGREEING = 2  # neighbours of the query that must see the place; or the keyframes after it
PATIENCE = 3  # keyframes within which another must confirm a loop whose query has too few neighbours
SAME_ANGLE, SAME_SHIFT = np.radians(3.0), 0.15  # how far two loops of one return may differ; median depths
UNMEASURED = 10.0  # sigma of the log of a ratio that nothing measures
PLACE_TO_PLACE = 0.06  # of the log of a part's unit, sigma: it wavers (scale/spread.py)
EXPLAINED = 0.8  # of a loop's points by the map as it stands: nothing is to be moved
SLIGHT_STRETCH = 0.02  # a window's own work mends that
SAME_RETURN = 5  # keyframes within which coming back to one place is one return
FUSED_NEIGHBOURS, FUSE_RADIUS = 5, 5.0
MOST_ACCEPTED = 1000  # remembered; the map itself has had what an older one had to say
REST = 8  # keyframes between the beginnings of two global adjustments
REST_NS = 10_000_000_000  # or so long: a camera in a known place makes hardly any


UnitsKnown = Callable[[int, int], tuple[float, float] | None]  # of two parts: (log, sigma)


def _nothing_known(part: int, other: int) -> None:
    return None


@dataclass(frozen=True)
class Accepted:
    """A loop as it was accepted, for reports."""

    query: int
    candidate: int
    query_index: int  # frames
    candidate_index: int
    candidate_from_query: Array
    inliers: int
    # Of separate parts: log of the newer one's unit in the older one's, which it now has, and its sigma.
    units: tuple[float, float] | None = None


@dataclass
class MapChanges:
    """What loops changed besides places; the tracker must do the same."""

    fused: list[tuple[int, int]] = field(default_factory=list)  # from, into
    added: list[tuple[int, int, int]] = field(default_factory=list)  # keyframe, point, keypoint
    dropped: list[tuple[int, int]] = field(default_factory=list)  # keyframe, point


class LoopCloser:
    """Watches one map for returns. Nothing here reads a clock."""

    def __init__(self, world: GlobalMap, config: BackendConfig, use_depth: bool, seed: int = 0) -> None:
        """``world`` may be a map that was there before."""
        self._world, self._config, self._use_depth, self._seed = world, config, use_depth, seed
        self.index = PlaceIndex()
        self.accepted: list[Accepted] = []
        self._unconfirmed: list[Loop] = []
        self._part: set[int] | None = None  # what hangs together with the query,
        self._ways: dict[int, Way] = {}  # ... and how far it is there (:func:`ways`)
        self._adjustment: GlobalAdjustment | None = None
        self._wanted = False  # there is something that no global adjustment has seen
        self._last_begun = -REST
        self._count, self._newest = 0, -1  # keyframes looked at; the newest of them
        self._now_ns = self._begun_ns = 0  # stamps of the last of them, and of that when one was last begun
        self._lens = LensWatch(config.lens, len(world.keyframes))
        self._finds_lens = False  # the adjustment under way
        self.changes = MapChanges()

    def add_place(self, keyframe: int, descriptor: F32, network: str = "") -> bool:
        """Note what a keyframe looks like to the network; False where that says nothing."""
        return keyframe in self._world.keyframes and self.index.add(keyframe, descriptor, network)

    def look(self, query: int, known: UnitsKnown = _nothing_known) -> Accepted | None:
        """Look for a return to an earlier place; what is accepted is in the map when this returns.

        ``query`` is the newest keyframe, or one whose descriptor has come since. ``known`` is asked for the
        log of one part's unit in another's, and its sigma, where a loop joins two: None, nothing.
        """
        if query > self._newest:
            self._newest = query
            self._count += 1
            if query in self._world.keyframes:
                self._now_ns = self._world.keyframes[query].stamp_ns
        self._part = None
        for loop in self._verified(query):
            if self._confirmed(loop) and self._close(*self._with_known_units(loop, known)):
                return self.accepted[-1]
        return None

    def _verified(self, query: int) -> list[Loop]:
        if query not in self._world.keyframes:
            return []
        world, found, without = self._world, [], self._just_closed(query)
        alike = candidates(world, self.index, query, CANDIDATES, without)
        known = half_known(world, query, HALF_KNOWN, without)
        for candidate in [*alike, *(k for k in known if k not in alike)]:
            # Tracking has found points of what is half known where the map has them: drift is small there.
            least, blindly = self._config.loop_inliers, candidate in alike
            loop = verify(world, query, candidate, least, self._seed, blindly)
            if loop is not None:
                found.append(loop)
        return sorted(found, key=lambda loop: -loop.inliers)

    def _just_closed(self, query: int) -> set[int]:
        """Keyframes of the places that the last few keyframes were found to be back at."""
        near: set[int] = set()
        for loop in self.accepted[-SAME_RETURN:]:
            if query - loop.query <= SAME_RETURN and loop.candidate in self._world.keyframes:
                near.add(loop.candidate)
                near.update(self._world.neighbours(loop.candidate))
        return near

    def _confirmed(self, loop: Loop) -> bool:
        """Whether neighbours of the query, or keyframes just before it, say the same."""
        recent = [other for other in self._unconfirmed if abs(loop.query - other.query) <= PATIENCE]
        self._unconfirmed = recent
        apart = not self._connected(loop)
        if not apart and not plausible(self._world, loop, self._ways.get(loop.candidate)):
            log.info("loop %d-%d asks for more drift than there can be", loop.query, loop.candidate)
            return False
        self._unconfirmed = [*recent, loop]  # what can't be is no witness of what barely can
        confirmed = any(other.query != loop.query and self._alike(loop, other) for other in recent)
        # Between separate parts of the map no way bounds what a look-alike may ask for: both must agree.
        return (confirmed and loop.neighbours >= 1) if apart else (confirmed or loop.neighbours >= AGREEING)

    def _alike(self, loop: Loop, other: Loop) -> bool:
        """Whether two loops move the newest part of the map by the same motion."""
        world = self._world
        if other.query not in world.keyframes:
            return False
        view = world.keyframes[loop.query]
        there = loop.world_from_query @ inverse(view.world_from_camera)
        also = other.world_from_query @ inverse(world.keyframes[other.query].world_from_camera)
        off = inverse(also @ view.world_from_camera) @ there @ view.world_from_camera
        near = float(np.linalg.norm(off[:3, 3])) < SAME_SHIFT * median_depth(world, view)
        return near and rotation_angle(off[:3, :3]) < SAME_ANGLE

    def _connected(self, loop: Loop) -> bool:
        if self._part is None:  # once for all candidates of a query: it goes through the whole map
            edges = with_bridges(self._world, covisibility(self._world, self._pairs()))
            self._part, self._ways = reachable(edges, {loop.query}), ways(self._world, edges, loop.query)
        return loop.candidate in self._part

    def _pairs(self) -> list[tuple[int, int]]:
        return [(a.candidate, a.query) for a in self.accepted]

    def _with_known_units(self, loop: Loop, known: UnitsKnown) -> tuple[Loop, float]:
        """Between two parts of the map: with the units' ratio weighed against what is known of it otherwise.

        And the sigma of the ratio's logarithm as the loop alone has it: who is told of the join knows what
        both parts' metres say.

        A loop measures it by a few points at the very place where it closes, and a part made on the way home,
        by turns, has there another unit than elsewhere. Points that nothing has triangulated yet are all off
        together, as one depth image placed them: they measure nothing.
        """
        view, there = (self._world.keyframes[k] for k in (loop.query, loop.candidate))
        if view.part is None or there.part is None or self._connected(loop):
            return loop, loop.log_scale_sigma
        if (told := known(view.part, there.part)) is None:
            return loop, loop.log_scale_sigma
        by_metres, their_sigma = told
        if self._firm(view, loop) < MIN_SCALED:
            return replace(loop, scale=math.exp(by_metres), log_scale_sigma=their_sigma), UNMEASURED
        sigma = math.hypot(loop.log_scale_sigma, PLACE_TO_PLACE)
        share = their_sigma**2 / (their_sigma**2 + sigma**2)
        log_scale = share * math.log(loop.scale) + (1.0 - share) * by_metres
        return replace(loop, scale=math.exp(log_scale), log_scale_sigma=sigma * math.sqrt(share)), sigma

    def _firm(self, view: GlobalKeyframe, loop: Loop) -> int:
        """How many points of a loop both ends have triangulated, each its own."""
        own, points = {keypoint: point for point, keypoint in view.observed.items()}, self._world.points
        both = ((own[keypoint], point) for keypoint, point in loop.pairs if keypoint in own)
        there = ((points[a], points[b]) for a, b in both if a != b and a in points and b in points)
        return sum(min(a.parallax_deg, b.parallax_deg) >= TRIANGULATED_DEG for a, b in there)

    def _close(self, loop: Loop, unit_sigma: float | None = None) -> bool:
        world = self._world
        query, candidate = world.keyframes[loop.query], world.keyframes[loop.candidate]
        units, moved, connected = None, pose_graph.Moved(), self._connected(loop)
        slight = connected and self._slight(loop, query)
        if connected and not slight:
            loop = with_free_points(world, loop)
        # As it was measured: what the loop moves may take the candidate along.
        relative = inverse(candidate.world_from_camera) @ loop.world_from_query
        if not slight:
            found = pose_graph.spread(world, loop, self._pairs())
            if found is None:
                return False
            moved, log_unit = found
            sigma = loop.log_scale_sigma if unit_sigma is None else unit_sigma
            units = None if log_unit is None else (log_unit, sigma)
            pose_graph.apply(world, moved)
            if log_unit is not None and query.part is not None and candidate.part is not None:
                newer = max(query.part, candidate.part)
                for part in {newer, *_moved_alone(world, moved)}:  # others were joined to it before
                    world.part_grew(part, math.exp(log_unit))
        ends = loop.query, loop.candidate, query.index, candidate.index
        self.accepted.append(Accepted(*ends, relative, loop.inliers, units))
        self._in_new_units(moved)
        if len(self.accepted) > MOST_ACCEPTED:
            self._forget_one()
        made = self._join(query, [(i, world.present(p)) for i, p in loop.pairs])
        made += self._join_neighbours(loop)
        self._unconfirmed.clear()
        self._wanted = True
        self._adjustment = None  # what it began with is out of date
        log.info(
            "loop: keyframe %d is back at %d (%d points agree, %d keyframes beside it; %d points joined)",
            loop.query,
            loop.candidate,
            loop.inliers,
            loop.neighbours,
            made,
        )
        return True

    def _in_new_units(self, moved: pose_graph.Moved) -> None:
        """What loops have measured in a part whose unit is another now."""
        for i, loop in enumerate(self.accepted):
            at = moved.get(loop.candidate) or moved.get(loop.query)  # one may have been culled
            if at is not None and at.unit != 1.0:
                relative = scaled(loop.candidate_from_query, at.unit)
                self.accepted[i] = replace(loop, candidate_from_query=relative)

    def _forget_one(self) -> None:
        """The oldest loop with an end that was culled, else the oldest: its ends share points by now."""
        here = self._world.keyframes
        gone = (i for i, a in enumerate(self.accepted) if a.query not in here or a.candidate not in here)
        del self.accepted[next(gone, 0)]

    def _slight(self, loop: Loop, query: GlobalKeyframe) -> bool:
        """Whether the map explains it as it stands: a pose alone goes wrong with its points' depths."""
        stretch = abs(float(np.log(loop.scale)))
        if stretch > max(SLIGHT_STRETCH, 2.0 * loop.log_scale_sigma):
            return False
        return explained(self._world, query, loop.pairs) >= EXPLAINED

    def _join_neighbours(self, loop: Loop) -> int:
        """What the keyframes beside the query see of the place."""
        world, made = self._world, 0
        surroundings = Surroundings(world, loop.candidate, without=loop.query)
        inside = set(surroundings.keyframes)
        near = [k for k in world.neighbours(loop.query) if k not in inside]
        for k in near[:FUSED_NEIGHBOURS]:
            view = world.keyframes[k]
            found = surroundings.look(view, view.world_from_camera, (FUSE_RADIUS,))
            if found is not None and len(found.keypoints) >= self._config.loop_inliers // 2:
                pairs = zip(found.keypoints.tolist(), found.points.tolist(), strict=True)
                made += self._join(view, [(i, world.present(p)) for i, p in pairs])
        return made

    def _join(self, view: GlobalKeyframe, pairs: list[tuple[int, int]]) -> int:
        """Let a keyframe see points of the other end; what it saw in their place becomes them."""
        world, made = self._world, 0
        own = {keypoint: point for point, keypoint in view.observed.items()}
        for keypoint, point in pairs:
            mine = own.get(keypoint)
            if point not in world.points or point in view.observed or mine == point:
                continue
            if mine is None or mine not in world.points:
                world.observe(view.id, point, keypoint)
                self.changes.added.append((view.id, point, keypoint))
            elif not world.points[mine].keyframes & world.points[point].keyframes:
                # Two points that one keyframe tells apart are two.
                world.fuse(mine, point)
                self.changes.fused.append((mine, point))
            else:
                continue
            made += 1
        return made

    # -- the global adjustment ------------------------------------------------------------------------

    @property
    def adjusting(self) -> bool:
        """Whether a global adjustment has begun, or should."""
        due = self._count - self._last_begun >= REST or self._now_ns - self._begun_ns >= REST_NS
        return self._adjustment is not None or (self._wanted and due) or self._lens.due(self._world)

    @property
    def under_way(self) -> bool:
        """Whether a global adjustment has begun."""
        return self._adjustment is not None

    def overhaul(self) -> None:
        """All keypoints are elsewhere now: everything is to be adjusted to that, and soon."""
        self._adjustment = None  # of what there was
        self._wanted, self._last_begun = True, self._count - REST

    def finish(self) -> None:
        """Nothing more will come: what no global adjustment has seen is to be adjusted, loop or not."""
        self._wanted = self._wanted or self._count > self._last_begun
        self._lens.finish()

    @property
    def unfinished(self) -> bool:
        """Whether there is something that a global adjustment is still to see."""
        return self._adjustment is not None or self._wanted or self._lens.due(self._world)

    def adjust(self, units_per_metre: float) -> global_adjustment.Adjusted | None:
        """Take the next step of the global adjustment; its result, already in the map, with the last one."""
        if self._adjustment is None:
            self._begin(units_per_metre)
            return None
        if not self._adjustment.step():
            return None
        adjusted, self._adjustment = self._adjustment.result(), None
        sound = adjusted is not None and adjusted.error_after <= adjusted.error_before
        if self._finds_lens:
            sound = self._believes(adjusted.lens if adjusted is not None and sound else None)
        if adjusted is None or not sound:
            return None
        self.changes.dropped += global_adjustment.apply(self._world, adjusted, self._config)
        log.info(
            "global adjustment: %d keyframes, %d points, %d steps, %.2f s of CPU, error %.0f to %.0f",
            len(adjusted.poses),
            len(adjusted.points),
            adjusted.steps,
            adjusted.cpu_s,
            adjusted.error_before,
            adjusted.error_after,
        )
        return adjusted

    def _begin(self, units_per_metre: float) -> None:
        """A lens is looked for first: what else is wanted then begins with it."""
        self._finds_lens = self._lens.due(self._world)
        if not self._finds_lens:
            self._wanted, self._last_begun, self._begun_ns = False, self._count, self._now_ns
        parts = joined_pieces(self._world, self._pairs())
        try:
            said = self._lens.said(self._world) if self._finds_lens else None
            self._adjustment = GlobalAdjustment(
                self._world, self._config, units_per_metre, self._use_depth, parts, said
            )
        except RuntimeError as error:
            log.warning("no global adjustment: %s", first_line(error, 200))
            if self._finds_lens:
                self._lens.looked(self._world)

    def _believes(self, lens: Lens | None) -> bool:
        """Whether a lens is taken over; all that the search had no part in is then to be adjusted to it."""
        if lens is not None and common(self._world) != lens.was:  # another camera has come meanwhile
            lens = None
        taken = self._lens.looked(self._world, lens)
        if lens is not None:
            says = "is off, and taken out from now on" if taken else "stays as it is"
            number, off = len(self._world.keyframes), radial(lens.camera) - lens.said
            log.info("lens: k1 %s (%+.4f, sigma %.4f, %d keyframes)", says, off, lens.sigma, number)
        if taken:
            self.overhaul()
        return taken

    def take_changes(self) -> MapChanges:
        """What has changed since this was last asked."""
        taken, self.changes = self.changes, MapChanges()
        return taken


def _moved_alone(world: GlobalMap, moved: pose_graph.Moved) -> set[int]:
    """The parts whose keyframes have all come into another unit."""
    of = {k: world.keyframes[k].part for k in moved}
    kept = {of[k] for k, at in moved.items() if at.unit == 1.0}
    return {part for k, part in of.items() if part is not None and moved[k].unit != 1.0 and part not in kept}
