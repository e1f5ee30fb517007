"""The pose of a view by the map points that it sees, each as doubtful as it is: of frames and keyframes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from prism_edge.geometry.poses import Array
from prism_edge.tracking.local_map import LocalMap
from prism_edge.tracking.motion import Prediction
from prism_edge.tracking.point_table import Ids, Index, PointTable
from prism_edge.tracking.point_trust import trust
from prism_edge.tracking.pose_refinement import PoseEstimate, refine_pose
from prism_edge.tracking.view import View

SEED_SIGMA = 0.1  # relative depth error beyond which a point counts as a seed
ENOUGH_TRIANGULATED = 60
SHARED_SEED_ERROR = 5.0
ROUNDS = (3, 3)  # of the solver, and steps in each
Centres: TypeAlias = tuple[Ids, Array]


@dataclass(frozen=True)
class PoseFromMap:
    """How poses follow from points; with ``proven_after_s`` 0 a point's age says nothing (point_trust.py)."""

    scale_factors: Array  # (levels,) of the pyramid
    proven_after_s: float = 0.0

    def now(self, world: LocalMap, taken_ns: int) -> int:
        """Until when points have grown old, in a view that was taken at a time (ns).

        To the newest keyframe: on a drive what is near, and tells the way, is never old, and is not to count
        for less than that. But a camera that stands makes none, and what it watches grows old all the same,
        ``proven_after_s`` later.
        """
        return max(world.newest().stamp_ns, taken_ns - round(1e9 * self.proven_after_s))

    def estimate(
        self,
        world: LocalMap,
        view: View,
        start: Array,
        rows: Index,
        keypoints: Index,
        rounds: tuple[int, int] = ROUNDS,
        centres: Centres | None = None,
        prediction: Prediction | None = None,
    ) -> PoseEstimate:
        """world_from_camera, from ``start`` on, by ``keypoints`` (n,) that show the points in ``rows``."""
        table = world.points
        return refine_pose(
            view.camera,
            start,
            table.position.take(rows, axis=0),
            view.features.pixels.take(keypoints, axis=0),
            self.scale_factors.take(view.features.octaves.take(keypoints)),
            shared_depth_error(world, rows, centres),
            trust(table, rows, self.now(world, view.taken_ns), self.proven_after_s),
            rounds=rounds[0],
            iterations=rounds[1],
            prediction=prediction,
        )


def shared_depth_error(world: LocalMap, rows: Index, centres: Centres | None = None) -> Array:
    """Errors along the first rays; seeds of one network share theirs, so many of them tell little more.

    Beside enough triangulated points a seed is left to fix what its first ray says, not its depth.
    """
    error = depth_error(world.points, rows, reference_origins(world, rows, centres))
    seeds = np.flatnonzero(world.points.log_depth_sigma.take(rows) > SEED_SIGMA)
    if len(rows) - len(seeds) >= ENOUGH_TRIANGULATED:
        error[seeds] *= SHARED_SEED_ERROR
    return error


def depth_error(table: PointTable, rows: Index, origins: Array) -> Array:
    """One-sigma error vectors (n, 3) of points along the rays from ``origins`` that first saw them."""
    return (table.position.take(rows, axis=0) - origins) * table.log_depth_sigma.take(rows)[:, None]


def reference_origins(world: LocalMap, rows: Index, centres: Centres | None = None) -> Array:
    """Where the camera was that created each point, or of the keyframe that a culled one handed it on to.

    ``centres`` are the map's :meth:`~prism_edge.tracking.local_map.LocalMap.centres`, where they are at hand.
    """
    numbers, places = world.centres() if centres is None else centres
    origins: Array = places.take(np.searchsorted(numbers, world.points.reference.take(rows)), axis=0)
    return origins
