"""What the backend has not corrected yet, the tracker adjusts by itself: its newest keyframes.

A backend that is behind, on a slow or busy computer, corrects the map a second and more after it was made.
Until then each keyframe rests on the one before, and where the camera turns to what is new the map bends, or
grows or shrinks with nothing to say otherwise. Older points and keyframes are held; where the backend keeps
up there is nothing to do.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from prism_edge.geometry.poses import Array, inverse, normalised, transform
from prism_edge.tracking.depth_alignment import agreement
from prism_edge.tracking.frame_tracking import TrackedFrame
from prism_edge.tracking.local_adjustment import Problem, adjust
from prism_edge.tracking.local_map import LocalKeyframe, LocalMap
from prism_edge.tracking.map_correction import refit
from prism_edge.tracking.point_table import Index
from prism_edge.tracking.pose_from_map import PoseFromMap, depth_error, reference_origins
from prism_edge.tracking.triangulation import rays

MOST_FREE = 8  # keyframes, the newest
LEAST_OLD = 12  # keyframes: of a younger map each window of the backend is the whole, and gives it its shape
LEAST_HELD = 30  # observations that hold what is free to the rest
IMAGE_SIGMA = 0.15  # of the log of what a network says of one image's size, at least
LEAST_TOLD, LEAST_IMAGES = 20, 3  # points of an image, and such images, that show how far it was off so far


def adjust_unheard(
    world: LocalMap,
    least: int,
    units_per_metre: float,
    pose: PoseFromMap,
    last: TrackedFrame | None = None,
) -> bool:
    """Adjust the keyframes that no correction knew, where they are ``least`` or more, and what they made.

    Whether it was done: not in a young map, nor where too little holds the new ones to the old. The ``last``
    frame moves with its surroundings.
    """
    unheard = [k for k in sorted(world.keyframes) if k > world.heard]
    if not 0 < least <= len(unheard) <= len(world.keyframes) - LEAST_OLD:
        return False
    free = [world.keyframes[k] for k in unheard[-MOST_FREE:]]
    numbers = [keyframe.id for keyframe in free]
    beside = {n for keyframe in free for n in keyframe.neighbours if n in world.keyframes}
    views = [*free, *(world.keyframes[n] for n in sorted(beside.difference(numbers)))]
    rows, own = _points_of(world, free, numbers)
    problem = _assemble(world, views, len(free), rows, own, units_per_metre, pose.scale_factors)
    held = (problem.view >= problem.free_views) | (problem.point >= problem.free_points)
    if held.sum() < LEAST_HELD:
        return False
    poses = np.array([keyframe.world_from_camera for keyframe in views])
    found = adjust(problem, poses, world.points.position[rows])
    if found is None:
        return False
    motion = _take_over(world, free, rows[:own], *found)
    if last is not None:
        start = motion @ last.world_from_camera
        refit(world, last, start, pose)
    return True


def _points_of(world: LocalMap, free: list[LocalKeyframe], numbers: list[int]) -> tuple[Index, int]:
    """Rows of the points that free keyframes see, those that are free to move first, and how many those are.

    Free are what they made and a second keyframe sees; what only its maker sees would hold that in its place.
    """
    table = world.points
    rows = table.rows(np.unique(np.concatenate([keyframe.points[keyframe.observed()] for keyframe in free])))
    made = np.isin(table.reference[rows], numbers)
    own = rows[made & (table.observations[rows] >= 2)]
    return np.concatenate([own, rows[~made]]), len(own)


def _assemble(
    world: LocalMap,
    views: list[LocalKeyframe],
    free: int,
    rows: Index,
    own: int,
    units_per_metre: float,
    scale_factors: Array,
) -> Problem:
    table = world.points
    place = np.full(len(table), -1, np.intp)
    place[rows] = np.arange(len(rows))
    sigma = max(IMAGE_SIGMA, _off(world, views[free:], units_per_metre))
    columns: list[tuple[NDArray[np.generic], ...]] = []
    for i, keyframe in enumerate(views):
        keypoints = keyframe.observed()
        point = place[table.rows(keyframe.points[keypoints])]
        # Of a held keyframe what it says of free points, of a free one all.
        said = (point >= 0) & (point < (len(rows) if i < free else own))
        keypoints, point = keypoints[said], point[said]
        sharp = 1.0 / scale_factors[keyframe.features.octaves[keypoints]]
        sharp = sharp[:, None] * (keyframe.camera.fx, keyframe.camera.fy)
        metres = np.zeros(len(point))
        if i < free and keyframe.metres is not None:
            metres = np.where(point < own, keyframe.metres[keypoints], 0.0)
        known = metres > 0.0
        vote = known / (sigma * np.sqrt(max(int(known.sum()), 1)))
        log_depth = np.log(np.where(known, units_per_metre * metres, 1.0))
        seen = rays(keyframe.camera, keyframe.features.pixels[keypoints])[:, :2]
        columns.append((np.full(len(point), i), point, seen, sharp, log_depth, vote))
    view, point, seen, inverse_sigma, log_depth, vote = (
        np.concatenate(column) for column in zip(*columns, strict=True)
    )
    doubt = depth_error(table, rows, reference_origins(world, rows))
    doubt[:own] = 0.0
    return Problem(
        free,
        own,
        view,
        point,
        seen,
        inverse_sigma,
        table.weight[rows][point],
        doubt,
        log_depth,
        vote,
    )


def _off(world: LocalMap, held: list[LocalKeyframe], units_per_metre: float) -> float:
    """How far (log) the network was off about the size of images that are held; 0 of too few."""
    said = []
    for keyframe in held:
        if keyframe.metres is not None:
            keypoints, depths = world.depths_in(keyframe)
            metres = units_per_metre * keyframe.metres[keypoints]
            good = (metres > 0.0) & (depths > 0.0)
            if good.sum() >= LEAST_TOLD:
                said.append(np.log(agreement(depths[good], metres[good]).units_per_metre))
    return float(np.sqrt(np.mean(np.square(said)))) if len(said) >= LEAST_IMAGES else 0.0


def _take_over(
    world: LocalMap, free: list[LocalKeyframe], own: Index, poses: Array, positions: Array
) -> Array:
    """Move free keyframes and points, and with each keyframe what it made besides; the newest's motion."""
    table = world.points
    table.position[own] = positions[: len(own)]
    along = table.alive.copy()
    along[own] = False
    motion = np.eye(4)
    for keyframe, found in zip(free, poses, strict=False):  # behind them are poses of held ones
        pose = normalised(found)
        motion = pose @ inverse(keyframe.world_from_camera)
        keyframe.world_from_camera = pose
        rest = np.flatnonzero(along & (table.reference == keyframe.id))
        table.position[rest] = transform(motion, table.position[rest])
    return motion
