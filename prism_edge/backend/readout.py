"""How long a rolling shutter takes to read an image, found from the map itself.

A moving camera sees each row from elsewhere. An adjustment of keyframes and points that takes every row for
seen at once bends the map until most of that fits. So the readout is a variable beside poses and points, all
solved together: Gauss-Newton under a Huber kernel, points eliminated first (Schur's complement). How fast
each keyframe's camera was the tracker has said. Rows count from the middle one, when a pose was so.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import groupby
from operator import itemgetter

import numpy as np

from prism_edge.backend.global_map import GlobalKeyframe, GlobalMap
from prism_edge.geometry.cameras import LONGEST_READOUT_MS
from prism_edge.geometry.poses import Array, inverse, transform
from prism_edge.tracking.local_adjustment import Linear, Problem, Step, gauss_newton, linearise, moved_by
from prism_edge.tracking.point_table import TRIANGULATED_DEG
from prism_edge.tracking.rolling_shutter import seen_at_once

FEWEST, MOST = 12, 60  # keyframes whose motion is known
OBSERVATIONS = 150  # of a keyframe: points that most others see
VIEWS = 3  # of a point at least: two rays cross wherever their rows were seen from
STEPS = 12
SETTLED = 0.05  # sigmas: a smaller step is the last
LEAST_DEPTH, LEAST_DAMPING = 1e-3, 1e-6
CLEAR, LEAST_MS = 5.0, 4.0  # sigmas (a map that is wrong makes up to four), and ms, from which on it is one
NEWS, LEAST_NEWS_MS = 3.0, 1.0  # the same, where it has been one before
WELL_KNOWN_MS = 1.0  # sigma


@dataclass(frozen=True)
class Readout:
    """By how much longer than is said an image is read, ms; below 0: shorter, or the last row first."""

    ms: float
    sigma_ms: float
    keyframes: int

    @property
    def is_clear(self) -> bool:
        """Whether it is surely another than is said."""
        return abs(self.ms) >= max(CLEAR * self.sigma_ms, LEAST_MS)

    @property
    def is_news(self) -> bool:
        """Whether one that was found before is to be followed."""
        return abs(self.ms) >= max(NEWS * self.sigma_ms, LEAST_NEWS_MS)

    @property
    def is_well_known(self) -> bool:
        """Whether it need not be looked for again so soon."""
        return self.sigma_ms < WELL_KNOWN_MS


@dataclass(frozen=True)
class Rows:
    """How the views of a problem moved, and when each observation's row was read."""

    twists: Array  # (views, 6) a second, in the camera's frame, map units
    after: Array  # (m,) share of the readout, from the middle row on: -0.5 to 0.5


def readout_of(world: GlobalMap) -> Readout | None:
    """What the newest keyframes say of the readout; None where too few of them say anything."""
    moved = [k for k in sorted(world.keyframes) if _moved(world.keyframes[k])][-MOST:]
    pairs = _chosen(world, moved)
    views = sorted({k for k, _ in pairs}, reverse=True)  # the first is the last, and held
    points = sorted({p for _, p in pairs})
    if len(views) < FEWEST:
        return None
    poses = np.array([world.keyframes[k].world_from_camera for k in views])
    positions = np.array([world.points[p].position for p in points])
    try:
        found = solve(*_problem(world, views, points, pairs), poses, positions)
    except np.linalg.LinAlgError:
        return None
    return Readout(1e3 * found[0], 1e3 * found[1], len(views)) if np.isfinite(found).all() else None


def take_out(world: GlobalMap, more_ms: float) -> None:
    """Move the keypoints of all keyframes by a readout that is so much more than is known; so are later ones.

    Those that came from a saved map stay: nobody knows how their camera moved.
    """
    known_ms = world.readout_ms
    world.readout_ms = max(-LONGEST_READOUT_MS, min(known_ms + more_ms, LONGEST_READOUT_MS))
    more_ms = world.readout_ms - known_ms
    for keyframe in world.keyframes.values():
        twist, depth = keyframe.present_twist, _depth(world, keyframe)
        pixels = seen_at_once(keyframe.pixels, keyframe.camera, twist, depth, more_ms)
        if pixels is not keyframe.pixels:
            keyframe.pixels, keyframe.features = pixels, keyframe.features.at(pixels, keyframe.camera)


def solve(problem: Problem, rows: Rows, poses: Array, positions: Array) -> tuple[float, float]:
    """The readout and its sigma, seconds, beside poses (views, 4, 4) and points (n, 3) that fit it best.

    Raises LinAlgError where nothing tells it.
    """
    readout_s, damping = 0.0, 1e-4
    at, by_readout = _linearised(problem, rows, poses, positions, readout_s)
    for _ in range(STEPS):
        step = gauss_newton(problem, at, damping, by_readout)
        more_s, sigma_s = float(step.shared[0]), _sigma(step)
        moved, shifted = moved_by(step, poses, positions)
        tried, by_tried = _linearised(problem, rows, moved, shifted, readout_s + more_s)
        if not tried.cost <= at.cost:
            damping *= 100.0
            continue
        poses, positions, readout_s, at, by_readout = moved, shifted, readout_s + more_s, tried, by_tried
        damping = max(0.1 * damping, LEAST_DAMPING)
        if abs(more_s) < SETTLED * sigma_s:
            break
    # Damped, all seems surer than it is.
    return readout_s, _sigma(gauss_newton(problem, at, LEAST_DAMPING, by_readout))


def _sigma(step: Step) -> float:
    return max(float(step.covariance[0, 0]), 0.0) ** 0.5


def _linearised(
    problem: Problem, rows: Rows, poses: Array, positions: Array, readout_s: float
) -> tuple[Linear, Array]:
    """The problem with rays as seen in the middle of such a readout; Jacobians (m, 3, 1) by it beside."""
    turned, centre = poses[problem.view, :3, :3], poses[problem.view, :3, 3]
    local = np.einsum("nji,nj->ni", turned, positions[problem.point] - centre)
    twists = rows.twists[problem.view]
    # A row that is read later is seen by a camera that has gone on.
    going = -twists[:, :3] - np.cross(twists[:, 3:], local)
    z = np.maximum(local[:, 2:], LEAST_DEPTH)
    aside = (going[:, :2] - local[:, :2] / z * going[:, 2:]) / z * rows.after[:, None]
    at = linearise(replace(problem, rays=problem.rays - readout_s * aside), poses, positions)
    by_readout = np.einsum("nij,nj->ni", at.by_twist, twists) * rows.after[:, None]
    return at, by_readout[:, :, None]


def _chosen(world: GlobalMap, keyframes: list[int]) -> list[tuple[int, int]]:
    """Pairs of keyframe and point: of each keyframe the points that most of the others see."""
    among = set(keyframes)
    views = {p: len(point.keyframes & among) for p, point in world.points.items()}
    firm = {
        p for p, n in views.items() if n >= VIEWS and world.points[p].parallax_deg >= TRIANGULATED_DEG
    }
    kept: set[int] = set()
    for k in keyframes:
        mine = sorted(world.keyframes[k].observed.keys() & firm, key=lambda p: (-views[p], p))
        kept.update(mine[:OBSERVATIONS])
    return [(k, p) for k in keyframes for p in sorted(world.keyframes[k].observed.keys() & kept)]


def _problem(
    world: GlobalMap, views: list[int], points: list[int], pairs: list[tuple[int, int]]
) -> tuple[Problem, Rows]:
    view_of, point_of = ({number: i for i, number in enumerate(of)} for of in (views, points))
    rays, after, sigmas = [], [], []
    for k, of in groupby(pairs, itemgetter(0)):
        keyframe = world.keyframes[k]
        keypoints = np.array([keyframe.observed[p] for _, p in of], np.intp)
        camera, pixels = keyframe.camera, keyframe.pixels[keypoints]
        focal = np.array([camera.fx, camera.fy])
        rays.append((pixels - [camera.cx, camera.cy]) / focal)
        after.append((camera.distort_pixels(pixels)[:, 1] + 0.5) / camera.height - 0.5)
        sigmas.append(focal / keyframe.sigmas[keypoints, None])
    none = np.zeros(len(pairs))  # the network has no say
    problem = Problem(
        len(views) - 1,
        len(points),
        np.array([view_of[k] for k, _ in pairs], np.intp),
        np.array([point_of[p] for _, p in pairs], np.intp),
        np.concatenate(rays),
        np.concatenate(sigmas),
        np.ones(len(pairs)),
        np.zeros((len(points), 3)),
        none,
        none,
    )
    return problem, Rows(np.array([world.keyframes[k].present_twist for k in views]), np.concatenate(after))


def _moved(keyframe: GlobalKeyframe) -> bool:
    return bool(np.isfinite(keyframe.twist).all() and keyframe.twist.any())


def _depth(world: GlobalMap, keyframe: GlobalKeyframe) -> float:
    """Median of what a keyframe sees, map units; 0 where it sees nothing before it."""
    places = np.array([world.points[p].position for p in keyframe.observed]).reshape(-1, 3)
    depths = transform(inverse(keyframe.world_from_camera), places)[:, 2]
    return float(np.median(depths[depths > 0.0])) if (depths > 0.0).any() else 0.0
