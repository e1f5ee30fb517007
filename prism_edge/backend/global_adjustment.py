"""Bundle adjustment of all keyframes, a step at a time so that whoever runs it can answer in between."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L, X
from numpy.typing import NDArray

from prism_edge.backend import lens
from prism_edge.backend.elimination import points_first, solver
from prism_edge.backend.factors import FactorFactory, held
from prism_edge.backend.frame import keep_frame
from prism_edge.backend.global_map import GlobalMap
from prism_edge.backend.settling import CONVERGED
from prism_edge.backend.sizes import size_factors, sizes
from prism_edge.backend.window import outliers, widest_parallax
from prism_edge.config import BackendConfig
from prism_edge.geometry.poses import Array, from_rt, inverse, normalised, transform
from prism_edge.tracking.point_table import TRIANGULATED_DEG

MOST_STEPS = 12
OBSERVATIONS = 250  # of a keyframe at most
# Views of a point at most: all poses that see it hang together once it is eliminated, in a matrix that grows
# with their square (288 bytes a pair, for all points at a time: hence MOST_PAIRS). So in a large map of one
# place fewer are used, down to FEWEST_VIEWS. And of a keyframe at least, where others see the same points.
MOST_VIEWS, FEWEST_VIEWS, MOST_PAIRS, FEWEST_SEEN = 30, 6, 250_000, 20
# Times a pixel's sigma: what is beyond its 99 % bound (3 sigmas) is no observation of that point, where the
# lens is unknown, and else. Of the latter there are a handful in thousands where a loop is to be adjusted.
FAR_OFF, ASTRAY = 3.0, 6.6


@dataclass(frozen=True)
class Adjusted:
    """Where the keyframes and points belong that were there when it began."""

    poses: dict[int, Array]
    points: dict[int, Array]
    error_before: float
    error_after: float
    steps: int
    cpu_s: float
    lens: lens.Lens | None = None  # where it was looked for


class GlobalAdjustment:
    """All keyframes (paper, section 3.5), the first pose held.

    With depth where that was measured; of a network's how large each place is (sizes.py).
    """

    def __init__(
        self,
        world: GlobalMap,
        config: BackendConfig,
        units_per_metre: float,
        use_depth: bool,
        parts: Iterable[set[int]] = (),
        said_k1: float | None = None,
    ) -> None:
        """Takes down the map as it is now; raises RuntimeError where gtsam can't begin.

        Of each of ``parts`` (all keyframes, by what hangs together) the first pose is held. With
        ``said_k1`` the lens of the one camera that took all keyframes is unknown too (lens.py); its file
        says that.
        """
        began = time.process_time()
        self._before = {k: keyframe.world_from_camera for k, keyframe in world.keyframes.items()}
        self._points = _choose_points(world)
        self._graph = graph = gtsam.NonlinearFactorGraph()
        values = gtsam.Values()
        factors = FactorFactory(config, units_per_metre)
        self._said = said_k1
        self._camera = camera = lens.common(world) if said_k1 is not None else None
        if camera is not None and said_k1 is not None:
            lens.add_variable(graph, values, camera, said_k1)
            self._points = _firm(world, self._points, config)
        used: dict[int, list[int]] = {}  # points of each keyframe, by the views that are used
        self._through: dict[int, list[int]] = {}  # points of each keyframe that tell the lens
        chosen = choose_views(world, self._points)
        if camera is None:
            chosen = _within_reach(world, chosen, config)
            self._points = list(chosen)
        for p, views in chosen.items():
            values.insert(L(p), world.points[p].position)
            for k in views:
                keyframe = world.keyframes[k]
                keypoint = keyframe.observed[p]
                used.setdefault(k, []).append(p)
                if camera is None:
                    graph.add(factors.reprojection(X(k), L(p), keyframe, keypoint))
                else:
                    graph.add(factors.reprojection_through(lens.LENS, X(k), L(p), keyframe, keypoint))
                    self._through.setdefault(k, []).append(p)
                measured = use_depth and keyframe.depth_sigma > 0  # a network would bend the map (window.py)
                if measured and keyframe.depths is not None and keyframe.depths[keypoint] > 0:
                    graph.add(factors.metric_depth(X(k), L(p), keyframe, keypoint))
        self._keyframes = sorted(used)
        self._measured = {k for k in used if use_depth and world.keyframes[k].depth_sigma > 0}
        for k in self._keyframes:
            values.insert(X(k), gtsam.Pose3(world.keyframes[k].world_from_camera))
        hanging = [part & used.keys() for part in (list(parts) or [set(used)]) if part & used.keys()]
        self._hanging, self._places = hanging, {p: world.points[p].position for p in chosen}
        self._first = {p: k for k in sorted(used, reverse=True) for p in used[k]}  # that sees each point
        if use_depth and camera is None:  # a bent map says nothing of sizes
            for part in hanging:
                for factor in size_factors(sizes(world, sorted(part), used)):
                    graph.add(factor)
        for k in sorted({min(part) for part in hanging}):
            graph.add(held(X(k), self._before[k]))
        if camera is not None:
            for part in hanging:
                lens.hold_unit(graph, {k: self._before[k] for k in part})
        last = [] if camera is None else [lens.LENS]
        self._ordering = points_first(self._points, self._keyframes, last)
        parameters = solver(self._ordering, len(self._keyframes))
        self._optimiser = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters)
        self._error_before = self._error = self._optimiser.error()
        self._steps = 0
        self.done = len(self._keyframes) < 3
        points = set(self._points)
        self._seen = {k: [p for p in world.keyframes[k].observed if p in points] for k in self._keyframes}
        self._depths = {
            k: _depths(self._before[k], [world.points[p].position for p in seen])
            for k, seen in self._seen.items()
        }
        self._cpu_s = time.process_time() - began

    def step(self) -> bool:
        """One iteration; True once there is nothing more to gain."""
        if self.done:
            return True
        began = time.process_time()
        try:
            self._optimiser.iterate()
        except RuntimeError:  # an indeterminate system: what there is so far has to do
            self.done = True
            return True
        self._steps += 1
        error = self._optimiser.error()
        self.done = self._steps >= MOST_STEPS or self._error - error < 10 * CONVERGED * self._error
        self._error = error
        self._cpu_s += time.process_time() - began
        return self.done

    def result(self) -> Adjusted | None:
        """What it came to, each part in the unit that it had or, of a sensor's depths, has; None: unusable.

        A part of its own of which that is so stays as it was: the rest is worth as much without it.
        """
        values = self._optimiser.values()
        poses = {k: np.asarray(values.atPose3(X(k)).matrix()) for k in self._keyframes}
        points = {p: np.asarray(values.atPoint3(L(p))) for p in self._points}
        if not poses or not all(np.isfinite(v).all() for v in (*poses.values(), *points.values())):
            return None
        # To its factor (gtsam's) a point behind the camera costs nothing: such a solution is worth nothing.
        depths = (_depths(poses[k], [points[p] for p in seen]) for k, seen in self._through.items())
        if any((depth <= 0.0).any() for depth in depths):
            return None
        bent = None
        if self._camera is not None and self._said is not None:
            bent = lens.found(self._graph, values, self._ordering, self._camera, self._said)
        if self._camera is not None and bent is None:
            return None  # places that go with a lens nobody can be sure of
        for part in self._hanging:
            unit = self._unit_change(part, poses, points)
            if not 0.5 < unit < 2.0:  # nothing says how large it is, or it has run off
                if self._keyframes[0] in part:
                    return None
                poses.update({k: self._before[k] for k in part})
                points.update({p: self._places[p] for p in self._owned(part)})
                continue
            if part & self._measured:  # by a sensor: it says how large that is
                continue
            anchor = poses[min(part)][:3, 3].copy()
            for k in part:
                turn, centre = poses[k][:3, :3], poses[k][:3, 3]
                poses[k] = normalised(from_rt(turn, anchor + (centre - anchor) / unit))
            for p in self._owned(part):
                points[p] = anchor + (points[p] - anchor) / unit
        return Adjusted(poses, points, self._error_before, self._error, self._steps, self._cpu_s, bent)

    def _owned(self, part: set[int]) -> list[int]:
        """The points that go with a part: it is where the first is that sees them."""
        return [p for p, k in self._first.items() if k in part]

    def _unit_change(self, part: set[int], poses: dict[int, Array], points: dict[int, Array]) -> float:
        """How much longer a part's lengths have become, on the median: its scale is for what they were.

        Of each part by itself: what another came to would change it a little more with every adjustment.
        """
        changes = []
        for k in sorted(part):
            seen = self._seen[k]
            if len(seen) >= 10:
                before, now = self._depths[k], _depths(poses[k], [points[p] for p in seen])
                good = (before > 1e-6) & (now > 1e-6)
                changes.append(float(np.median(np.log(now[good] / before[good]))) if good.any() else 0.0)
        return float(np.exp(np.median(changes))) if changes else 1.0


def _depths(world_from_camera: Array, places: list[Array]) -> Array:
    return transform(inverse(world_from_camera), np.array(places).reshape(-1, 3))[:, 2]


def apply(world: GlobalMap, adjusted: Adjusted, config: BackendConfig) -> list[tuple[int, int]]:
    """Take the result over; what came since moves with its surroundings. Returns observations found wrong."""
    if adjusted.lens is not None:
        world.take_lens(adjusted.lens.camera)
    motion: dict[int, Array] = {}
    were = {k: keyframe.world_from_camera for k, keyframe in world.keyframes.items()}
    for k in sorted(world.keyframes):
        keyframe, before = world.keyframes[k], were[k]
        if k in adjusted.poses:
            keyframe.world_from_camera = adjusted.poses[k]
        else:
            known = [o for o, _ in world.covisible(k) if o in motion] or sorted(motion)[-1:]
            if known:
                keyframe.world_from_camera = normalised(motion[known[0]] @ before)
        motion[k] = keyframe.world_from_camera @ inverse(before)
    moved: dict[int, Array] = {}
    for p, point in world.points.items():
        if p in adjusted.points:
            moved[p] = adjusted.points[p]
        elif point.keyframes:
            moved[p] = transform(motion[min(point.keyframes)], point.position[None])[0]
    for p, place in moved.items():
        world.points[p].position = place
    keep_frame(world)
    chosen = {p: world.points[p].position for p in adjusted.points if p in world.points}
    if not chosen:
        return []
    for p, angle in widest_parallax(world, chosen).items():
        world.points[p].parallax_deg = angle
    poses = {k: keyframe.world_from_camera for k, keyframe in world.keyframes.items()}
    seen = ((k, p) for p in chosen for k in sorted(world.points[p].keyframes))
    observations = [(k, p, world.keyframes[k].observed[p]) for k, p in seen]
    wrong = outliers(world, poses, chosen, observations, config)
    for k, p in wrong:
        world.drop_observation(k, p)
    return wrong


def _firm(world: GlobalMap, points: list[int], config: BackendConfig) -> list[int]:
    """Those whose rays cross and are near where they should be: others may slip behind a camera."""
    firm = {p: world.points[p] for p in points if world.points[p].parallax_deg >= TRIANGULATED_DEG}
    # A bent map is a few pixels off at its rim, and these are what tells the lens.
    wrong = {p for _, p in _beyond(world, {p: point.keyframes for p, point in firm.items()}, FAR_OFF, config)}
    return [p for p in firm if p not in wrong]


def _beyond(
    world: GlobalMap, views: Mapping[int, Iterable[int]], times: float, config: BackendConfig
) -> set[tuple[int, int]]:
    """Of the ``views`` of each point, keyframe and point of those that are outliers at so many sigmas."""
    places = {p: world.points[p].position for p in views}
    seen = [(k, p, world.keyframes[k].observed[p]) for p, of in views.items() for k in of]
    wide = replace(config, pixel_sigma=times * config.pixel_sigma)
    return set(outliers(world, {}, places, seen, wide))


def _choose_points(world: GlobalMap) -> list[int]:
    """Points that at least two keyframes see: of each keyframe those that most others see too."""
    chosen: set[int] = set()
    for k in sorted(world.keyframes):
        mine = [p for p in world.keyframes[k].observed if len(world.points[p].keyframes) >= 2]
        mine.sort(key=lambda p: (-len(world.points[p].keyframes), p))
        chosen.update(mine[:OBSERVATIONS])
    return sorted(chosen)


def choose_views(world: GlobalMap, points: list[int]) -> dict[int, list[int]]:
    """The keyframes, ascending, whose views of each point are used: all, but of many an even choice.

    Where a camera stays in one room for hours, hundreds of keyframes see the same points.
    """
    views: dict[int, list[int]] = {}
    seen: dict[int, list[int]] = {}
    most = _most_views(np.array([len(world.points[p].keyframes) for p in points]))
    for p in points:
        of = sorted(world.points[p].keyframes)
        if len(of) > most:
            # Not the same keyframes for all points: each begins elsewhere.
            of = [of[(i * len(of) + p % len(of)) // most] for i in range(most)]
        views[p] = of
        for k in of:
            seen.setdefault(k, []).append(p)
    for k in sorted({k for p in points for k in world.points[p].keyframes}):
        mine = seen.get(k, [])
        if len(mine) < FEWEST_SEEN:
            more = sorted((world.keyframes[k].observed.keys() & views.keys()) - set(mine))
            for p in more[: FEWEST_SEEN - len(mine)]:
                views[p] = sorted([*views[p], k])
    return views


def _within_reach(
    world: GlobalMap, views: dict[int, list[int]], config: BackendConfig
) -> dict[int, list[int]]:
    """The points that two views see or more which are no more than ASTRAY off, and those views.

    A robust kernel lets a mismatch pull a little, however far off it is. That is nothing beside what a map
    is sure of. But where a camera has turned on the spot little says how large what came after is beside
    what was before, and two of them have halved it.
    """
    astray = _beyond(world, views, ASTRAY, config)
    near = {p: [k for k in of if (k, p) not in astray] for p, of in views.items()}
    return {p: of for p, of in near.items() if len(of) >= 2}


def _most_views(counts: NDArray[np.intp]) -> int:
    """How many of a point's views can be used where points have so many (n,)."""
    for most in range(MOST_VIEWS, FEWEST_VIEWS, -1):
        if int((np.minimum(counts, most) ** 2).sum()) <= MOST_PAIRS:
            return most
    return FEWEST_VIEWS
