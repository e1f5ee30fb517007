"""What a loop says where its points may give way: whether the map explains it, and where it has the query.

A loop's pose rests on its points being where the map has them. Where these were seen under little parallax it
goes wrong with their depths, by far more than the noise of their pixels: depths that are off by 4 %, and by
much the same beside each other, are a scene turned by 10 degrees, and a view of it from aside turns with it.
So before a loop moves the map the points are put where all who see them, the query too, have them
(:func:`explained`); a map that has drifted can't do that. Then the query moves with them (:func:`placed`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from prism_edge.backend.global_map import GlobalKeyframe, GlobalMap
from prism_edge.geometry.poses import Array, normalised, se3_exp, skew
from prism_edge.tracking.pose_refinement import HUBER

AGREES = 5.0  # sigmas of a pixel: what a window's own work takes out of what it begins with
STEPS = 8
DAMPING = 1e-3  # of the mean curvature: what no parallax holds stays about where it is
NEAREST = 1e-3  # along z: nearer is behind the camera
MOST_STEPS, SETTLED = 50, 1e-4  # of a query with its points: a relief is a long valley; of the cost
BEHIND = 1e3  # what a pixel costs whose point is behind the camera


def explained(world: GlobalMap, query: GlobalKeyframe, pairs: list[tuple[int, int]]) -> float:
    """The share of ``pairs`` (keypoint of the query, point) that the map's poses explain, query's included.

    A pair counts where one place of its point is within :data:`AGREES` of each pixel that shows it.
    """
    if not pairs:
        return 0.0
    views = _views(world, query, pairs)
    places = np.array([world.points[point].position for _, point in pairs])
    for _ in range(STEPS):
        residual, jacobian, _ = views.linearise(places)
        curvature = np.add.reduceat(np.einsum("nij,nik->njk", jacobian, jacobian), views.first)
        gradient = np.add.reduceat(np.einsum("nij,ni->nj", jacobian, residual), views.first)
        trace = np.einsum("nii->n", curvature)
        curvature += (DAMPING * trace + 1e-12)[:, None, None] * np.eye(3)
        places = places - np.linalg.solve(curvature, gradient[:, :, None])[:, :, 0]
    residual, _, seen = views.linearise(places)
    fits = seen & (np.linalg.norm(residual, axis=1) < AGREES)
    return float(np.logical_and.reduceat(fits, views.first).mean())


@dataclass(frozen=True)
class Placed:
    """A query among points that gave way, and how surely it is there."""

    world_from_query: Array  # (4, 4)
    information: Array  # (6, 6) translation first, in the query's frame; what its points' doubts leave of it
    places: Array  # (pairs, 3) of the points
    deepening: Array  # (6,) how the mean of their log depths goes with such a twist, which they follow
    cost: float

    def depth_sigma(self) -> float:
        """Of that mean: what all depths share, however many they are."""
        depth = float(np.median(np.linalg.norm(self.places - self.world_from_query[:3, 3], axis=1)))
        return float(np.sqrt(self.deepening @ doubt(self.information, depth) @ self.deepening))


def doubt(information: Array, depth: float) -> Array:
    """The covariance (6, 6) of a query among points at a depth, where it is about in any case."""
    about = np.diag(np.repeat([1.0 / (depth * depth), 1.0], 3))
    return np.asarray(np.linalg.inv(information + about), np.float64)


def placed(
    world: GlobalMap, query: GlobalKeyframe, pairs: list[tuple[int, int]], starts: list[Array]
) -> Placed | None:
    """The query's pose by all who see the points of ``pairs``, other keyframes as they are; None without one.

    The best of several ``starts`` (world_from_query): where views are narrow, a turn and a step aside look
    alike, and each has a valley of its own.
    """
    if len(pairs) < 6:
        return None
    views = _views(world, query, pairs)
    places = np.array([world.points[point].position for _, point in pairs])
    found = [_settle(views, start, places) for start in starts]
    return min(found, key=lambda one: one.cost)


def _settle(views: _Views, pose: Array, places: Array) -> Placed:
    """Levenberg-Marquardt over the query's pose and the points, which are eliminated first."""
    problem, damping = _Reduced.at(views, pose, places), DAMPING
    for _ in range(MOST_STEPS):
        twist, shifts = problem.step(damping)
        tried = normalised(pose @ se3_exp(twist))
        there = _Reduced.at(views, tried, places + shifts)
        if there.cost < problem.cost:
            settled = problem.cost - there.cost < SETTLED * there.cost
            pose, places, problem, damping = tried, places + shifts, there, 0.1 * damping
            if settled:
                break
        elif damping > 1e3:
            break
        else:
            damping *= 10.0
    information, _, inverse_of_points = problem.eliminated(1e-6)
    deepening = _deepening(pose, places, -inverse_of_points @ problem.between.transpose(0, 2, 1))
    return Placed(pose, information, places, deepening, problem.cost)


def _deepening(pose: Array, places: Array, follow: Array) -> Array:
    """Slope (6,) of the points' mean log depth by the query's twist, where ``follow`` (n, 3, 6) is theirs."""
    local = (places - pose[:3, 3]) @ pose[:3, :3]
    slope = np.einsum("j,njk->nk", pose[:3, 2], follow)
    slope[:, 2] -= 1.0
    slope[:, 3] -= local[:, 1]
    slope[:, 4] += local[:, 0]
    ahead = local[:, 2] > NEAREST
    if not ahead.any():
        return np.zeros(6)
    mean: Array = (slope[ahead] / local[ahead, 2:]).mean(axis=0)
    return mean


@dataclass(frozen=True)
class _Reduced:
    """Normal equations of a query's pose and of points, at some of both; costs are Huber's."""

    cost: float
    of_pose: Array  # (6, 6)
    of_points: Array  # (points, 3, 3)
    between: Array  # (points, 6, 3)
    by_pose: Array  # (6,) gradients
    by_points: Array  # (points, 3)

    @classmethod
    def at(cls, views: _Views, pose: Array, places: Array) -> _Reduced:
        last = np.append(views.first[1:], len(views.point)) - 1  # of each point's views the query's
        turned, centres = views.turned.copy(), views.centres.copy()
        turned[last], centres[last] = pose[:3, :3], pose[:3, 3]
        residual, jacobian, seen = replace(views, turned=turned, centres=centres).linearise(places)
        size = np.maximum(np.linalg.norm(residual, axis=1), 1e-12)
        clipped = np.minimum(size, HUBER)
        cost = np.where(seen, np.minimum(clipped * (2.0 * size - clipped), BEHIND), BEHIND).sum()
        weight = np.where(seen, clipped / size, 0.0)
        weighed = jacobian * weight[:, None, None]
        local = (places - pose[:3, 3]) @ pose[:3, :3]
        # d(local) = -rho - phi x local, and the points' slopes are those by local, turned.
        by_local = jacobian[last] @ pose[:3, :3]
        mine = np.concatenate([-by_local, by_local @ np.array([skew(one) for one in local])], axis=2)
        mine_weighed = mine * weight[last, None, None]
        return cls(
            float(cost),
            np.einsum("nij,nik->jk", mine_weighed, mine),
            np.add.reduceat(np.einsum("nij,nik->njk", weighed, jacobian), views.first),
            np.einsum("nij,nik->njk", mine_weighed, jacobian[last]),
            np.einsum("nij,ni->j", mine_weighed, residual[last]),
            np.add.reduceat(np.einsum("nij,ni->nj", weighed, residual), views.first),
        )

    def eliminated(self, damping: float) -> tuple[Array, Array, Array]:
        """Curvature (6, 6) and gradient (6,) of the pose where points follow it; the points' inverse."""
        trace = np.einsum("nii->n", self.of_points)
        damped: Array = self.of_points + (damping * trace + 1e-12)[:, None, None] * np.eye(3)
        inverse_of_points = np.asarray(np.linalg.inv(damped), np.float64)
        gain = self.between @ inverse_of_points
        curvature: Array = self.of_pose - np.einsum("nij,nkj->ik", gain, self.between)
        return curvature, self.by_pose - np.einsum("nij,nj->i", gain, self.by_points), inverse_of_points

    def step(self, damping: float) -> tuple[Array, Array]:
        """Where to go: the pose's twist (6,) and the points' shifts (points, 3)."""
        curvature, gradient, inverse_of_points = self.eliminated(damping)
        curvature = curvature + np.diag(damping * np.diag(self.of_pose) + 1e-9)
        twist = -np.asarray(np.linalg.solve(curvature, gradient), np.float64)
        follow = self.by_points + np.einsum("nji,j->ni", self.between, twist)
        return twist, -np.einsum("nij,nj->ni", inverse_of_points, follow)


@dataclass(frozen=True)
class _Views:
    """Who sees the points, those of one point side by side."""

    point: NDArray[np.intp]  # (n,)
    first: NDArray[np.intp]  # (points,) where those of each begin
    turned: Array  # (n, 3, 3) world_from_camera
    centres: Array  # (n, 3)
    focal: Array  # (n, 2)
    principal: Array  # (n, 2)
    pixels: Array  # (n, 2), ideal
    sigmas: Array  # (n,)

    def linearise(self, places: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Whitened residuals (n, 2), their Jacobian (n, 2, 3) by the point, and who has it before it."""
        local = np.einsum("nji,nj->ni", self.turned, places[self.point] - self.centres)
        seen = local[:, 2] > NEAREST
        inverse_z = 1.0 / np.maximum(local[:, 2], NEAREST)
        plane = local[:, :2] * inverse_z[:, None]
        residual = (self.focal * plane + self.principal - self.pixels) / self.sigmas[:, None]
        by_local = np.zeros((len(local), 2, 3))
        by_local[:, [0, 1], [0, 1]] = 1.0
        by_local[:, :, 2] = -plane
        by_local *= (self.focal / self.sigmas[:, None] * inverse_z[:, None])[:, :, None]
        return residual, np.einsum("nij,nkj->nik", by_local, self.turned), seen


def _views(world: GlobalMap, query: GlobalKeyframe, pairs: list[tuple[int, int]]) -> _Views:
    seen = [
        (n, world.keyframes[k], world.keyframes[k].observed[point])
        for n, (keypoint, point) in enumerate(pairs)
        for k in sorted(world.points[point].keyframes - {query.id})
    ]
    seen = sorted([*seen, *((n, query, i) for n, (i, _) in enumerate(pairs))], key=lambda one: one[0])
    cameras = [view.camera for _, view, _ in seen]
    point = np.array([n for n, _, _ in seen], np.intp)
    return _Views(
        point,
        np.searchsorted(point, np.arange(len(pairs))),
        np.array([view.world_from_camera[:3, :3] for _, view, _ in seen]),
        np.array([view.world_from_camera[:3, 3] for _, view, _ in seen]),
        np.array([(camera.fx, camera.fy) for camera in cameras]),
        np.array([(camera.cx, camera.cy) for camera in cameras]),
        np.array([view.pixels[i] for _, view, i in seen]),
        np.array([view.sigmas[i] for _, view, i in seen]),
    )
