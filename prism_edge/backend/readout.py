"""How long a rolling shutter takes to read an image, found from the map itself.

A moving camera sees each row from elsewhere. An adjustment of keyframes and points that takes every row for
seen at once bends the map until most of that fits. So the readout is a variable beside poses and points, all
solved together: Gauss-Newton under a Huber kernel, points eliminated first (Schur's complement). How fast
each keyframe's camera was the tracker has said. Rows count from the middle one, when a pose was so.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import groupby
from operator import itemgetter

import numpy as np
from numpy.typing import NDArray

from prism_edge.backend.global_map import GlobalKeyframe, GlobalMap
from prism_edge.geometry.poses import Array, se3_exp
from prism_edge.tracking.point_table import TRIANGULATED_DEG
from prism_edge.tracking.pose_refinement import HUBER

Index = NDArray[np.intp]
FEWEST, MOST = 12, 60  # keyframes whose motion is known
OBSERVATIONS = 150  # of a keyframe: points that most others see
VIEWS = 3  # of a point at least: two rays cross wherever their rows were seen from
STEPS = 12
SETTLED = 0.05  # sigmas: a smaller step is the last
LEAST_DEPTH, LEAST_DAMPING = 1e-3, 1e-6
FLOOR = 1e-9  # of information: a direction that nothing measures stays where it is
HELD = 1e12  # times its own information, for the first pose
CLEAR, LEAST_MS = 6.0, 4.0  # sigmas (a map that is wrong makes up to four), and ms, from which on it is one


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


@dataclass(frozen=True)
class Seen:
    """Observations (m,) of points by views, and how each view moved."""

    view: Index
    point: Index
    rays: Array  # (m, 2) x and y at z = 1
    inverse_sigma: Array  # (m, 2) of those
    after: Array  # (m,) of the readout, from the middle row on: -0.5 to 0.5
    twists: Array  # (views, 6) a second, in the camera's frame, map units


def readout_of(world: GlobalMap) -> Readout | None:
    """What the newest keyframes say of the readout; None where too few of them say anything."""
    moved = [k for k in sorted(world.keyframes) if _moved(world.keyframes[k])][-MOST:]
    pairs = _chosen(world, moved)
    views = sorted({k for k, _ in pairs})
    points = sorted({p for _, p in pairs})
    if len(views) < FEWEST:
        return None
    seen = _seen(world, views, points, pairs)
    poses = np.array([world.keyframes[k].world_from_camera for k in views])
    found = solve(seen, poses, np.array([world.points[p].position for p in points]))
    return None if found is None else Readout(1e3 * found[0], 1e3 * found[1], len(views))


def solve(seen: Seen, poses: Array, positions: Array) -> tuple[float, float] | None:
    """The readout and its sigma, seconds, beside poses (views, 4, 4) and points (n, 3) that fit it best.

    None where nothing tells it.
    """
    try:
        return _solved(seen, poses, positions)
    except np.linalg.LinAlgError:
        return None


def _solved(seen: Seen, poses: Array, positions: Array) -> tuple[float, float] | None:
    readout_s, damping = 0.0, 1e-4
    at = _linearised(seen, poses, positions, readout_s)
    for _ in range(STEPS):
        twists, shifts, more_s, sigma_s = _step(seen, at, len(poses), len(positions), damping)
        moved = np.array([pose @ se3_exp(twist) for pose, twist in zip(poses, twists, strict=True)])
        tried = _linearised(seen, moved, positions + shifts, readout_s + more_s)
        if not tried.cost <= at.cost:
            damping *= 100.0
            continue
        poses, positions, readout_s, at = moved, positions + shifts, readout_s + more_s, tried
        damping = max(0.1 * damping, LEAST_DAMPING)
        if abs(more_s) < SETTLED * sigma_s:
            break
    *_, sigma_s = _step(seen, at, len(poses), len(positions), LEAST_DAMPING)  # damped, all seems surer
    return (readout_s, sigma_s) if np.isfinite((readout_s, sigma_s)).all() else None


@dataclass(frozen=True)
class _Linear:
    cost: float
    residual: Array  # (m, 2) whitened, as the Jacobians
    by_twist: Array  # (m, 2, 6)
    by_point: Array  # (m, 2, 3)
    by_readout: Array  # (m, 2)


def _linearised(seen: Seen, poses: Array, positions: Array, readout_s: float) -> _Linear:
    turned, centre = poses[seen.view, :3, :3], poses[seen.view, :3, 3]
    local = np.einsum("nji,nj->ni", turned, positions[seen.point] - centre)
    visible = local[:, 2] > LEAST_DEPTH
    z = np.where(visible, local[:, 2], 1.0)
    xy = local[:, :2] / z[:, None]
    scale = np.where(visible[:, None], seen.inverse_sigma, 0.0)
    by_local = np.zeros((len(z), 2, 3))
    by_local[:, 0, 0], by_local[:, 1, 1] = scale.T / z
    by_local[:, :, 2] = -xy * scale / z[:, None]
    by_twist = np.concatenate([-by_local, np.cross(by_local, local[:, None, :])], axis=2)
    # A row that is read later is seen by a camera that has gone on.
    by_readout = np.einsum("nij,nj->ni", by_twist, seen.twists[seen.view]) * seen.after[:, None]
    residual = (xy - seen.rays) * scale + readout_s * by_readout
    chi = np.sqrt(np.maximum(np.einsum("ni,ni->n", residual, residual), 1e-12))
    clipped = np.minimum(chi, HUBER)
    root = np.sqrt(clipped / chi)
    return _Linear(
        float((clipped * (2.0 * chi - clipped)).sum()),
        residual * root[:, None],
        by_twist * root[:, None, None],
        np.einsum("nij,nkj->nik", by_local, turned) * root[:, None, None],
        by_readout * root[:, None],
    )


def _step(
    seen: Seen, at: _Linear, views: int, points: int, damping: float
) -> tuple[Array, Array, float, float]:
    """Twists (views, 6), shifts (points, 3), more readout and its sigma (s) of one Gauss-Newton step."""
    last = 6 * views
    information, pull = np.zeros((last + 1, last + 1)), np.zeros(last + 1)
    for i in range(views):
        mine, block = seen.view == i, slice(6 * i, 6 * i + 6)
        by_twist = at.by_twist[mine].reshape(-1, 6)
        information[block, block] = by_twist.T @ by_twist
        information[block, last] = information[last, block] = by_twist.T @ at.by_readout[mine].ravel()
        pull[block] = by_twist.T @ at.residual[mine].ravel()
    information[last, last] = float((at.by_readout**2).sum())
    pull[last] = float((at.by_readout * at.residual).sum())
    hessian = _summed(seen.point, np.einsum("nki,nkj->nij", at.by_point, at.by_point).reshape(-1, 9), points)
    hessian = hessian.reshape(-1, 3, 3)
    gradient = _summed(seen.point, np.einsum("nki,nk->ni", at.by_point, at.residual), points)
    for matrix in (hessian, information[None, :last, :last]):
        diagonal = np.arange(matrix.shape[-1])
        matrix[:, diagonal, diagonal] = (1.0 + damping) * matrix[:, diagonal, diagonal] + FLOOR
    information[:6, :6] += HELD * np.diag(np.diag(information)[:6])
    cross = np.zeros((points, 3, last + 1))
    joint = cross[:, :, :last].reshape(points, 3, views, 6)
    joint[seen.point, :, seen.view, :] = np.einsum("nki,nkj->nij", at.by_point, at.by_twist)
    cross[:, :, :last] = joint.reshape(points, 3, last)
    by_readout = np.einsum("nki,nk->ni", at.by_point, at.by_readout)
    cross[:, :, last] = _summed(seen.point, by_readout, points)
    inverted = np.linalg.inv(hessian)
    solved = (inverted @ cross).reshape(3 * points, last + 1)
    reduced = information - cross.reshape(3 * points, last + 1).T @ solved
    step = -np.linalg.solve(reduced, pull - solved.T @ gradient.ravel())
    unit = np.zeros(last + 1)
    unit[last] = 1.0
    variance = float(np.linalg.solve(reduced, unit)[last])
    shifts = -np.einsum("nij,nj->ni", inverted, gradient) - (solved @ step).reshape(points, 3)
    twists = np.asarray(step[:last], np.float64).reshape(views, 6)
    return twists, np.asarray(shifts, np.float64), float(step[last]), max(variance, 0.0) ** 0.5


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


def _seen(world: GlobalMap, views: list[int], points: list[int], pairs: list[tuple[int, int]]) -> Seen:
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
    return Seen(
        np.array([view_of[k] for k, _ in pairs], np.intp),
        np.array([point_of[p] for _, p in pairs], np.intp),
        np.concatenate(rays),
        np.concatenate(sigmas),
        np.concatenate(after),
        np.array([_twist(world.keyframes[k]) for k in views]),
    )


def _moved(keyframe: GlobalKeyframe) -> bool:
    return bool(np.isfinite(keyframe.twist).all() and keyframe.twist.any())


def _twist(keyframe: GlobalKeyframe) -> Array:
    """As the tracker said it, in the unit that the keyframe's part has now."""
    return keyframe.twist * np.repeat((keyframe.grown, 1.0), 3)


def _summed(groups: Index, rows: Array, count: int) -> Array:
    """Rows (n, k) added up by group: (count, k)."""
    return np.stack([np.bincount(groups, column, count) for column in rows.T], axis=1)
