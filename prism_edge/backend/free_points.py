"""Whether a map explains as it stands what a loop found: its points may give way, its poses may not.

A loop's pose rests on its points being where the map has them. Where these were seen under little parallax it
goes wrong with their depths, by far more than the noise of their pixels. So before a loop moves the map the
points are put where all who see them, the query too, have them; a map that has drifted can't do that.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from prism_edge.backend.global_map import GlobalKeyframe, GlobalMap
from prism_edge.geometry.poses import Array

AGREES = 5.0  # sigmas of a pixel: what a window's own work takes out of what it begins with
STEPS = 8
DAMPING = 1e-3  # of the mean curvature: what no parallax holds stays about where it is
NEAREST = 1e-3  # along z: nearer is behind the camera


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
