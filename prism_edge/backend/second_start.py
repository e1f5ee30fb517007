"""Where a window on new ground might begin instead: from the network's depths, without the map.

A camera that turns quickly and moves little sees a turn one way and a step the other nearly alike. A map that
took the one for the other goes on to place new points by it, and soon fits what it sees in a valley of its
own, metres from the truth and with every pixel explained; no solver leaves it. The depths of single images
know nothing of that: by them one keyframe after the other is placed beside those before it, roughly but in
the right valley, and a window solved from there may fit the same pixels clearly better (window.py).
"""

from __future__ import annotations

from collections.abc import Sequence, Set

import numpy as np

from prism_edge.backend.global_map import GlobalKeyframe, GlobalMap
from prism_edge.geometry.poses import Array, inverse, transform
from prism_edge.tracking.point_table import Index
from prism_edge.tracking.pose_refinement import refine_pose

LEAST = 20  # points with depth that a keyframe shares with another, to be placed beside it
BESIDE = 2  # others that it is placed beside
DEPTH_ERROR = 0.1  # relative, of a network's depths within an image
LESS, SHARE = 5.0, 0.03  # of the cost (nats, and of the whole) that a window takes a second start for


def clearly_less(cost: float, before: float) -> bool:
    """Whether what a window costs is less than ``before`` by more than the noise of a solver that stops."""
    return before - cost > max(LESS, SHARE * before)


def second_start(
    world: GlobalMap, held: Sequence[int], free: Sequence[int], points: Sequence[int], pinned: Set[int]
) -> tuple[dict[int, Array], dict[int, Array]] | None:
    """Poses (4, 4) of the ``free`` keyframes and places (3,) of the points; None where depth can't give them.

    The held keyframes stay where they are, and the ``pinned`` points.
    """
    units = _units(world, [*held, *free])
    poses = {k: world.keyframes[k].world_from_camera for k in held}
    for k in sorted(free):
        pose = _placed_beside(world, world.keyframes[k], poses, units)
        if pose is None:
            return None
        poses[k] = pose
    places = {p: world.points[p].position for p in pinned}
    for k in sorted(poses):  # who saw a point first says how far it is
        keyframe = world.keyframes[k]
        mine = [p for p in points if p not in places and p in keyframe.observed]
        keypoints = np.array([keyframe.observed[p] for p in mine], np.intp)
        depths = _depths(keyframe, keypoints, units)
        seen = transform(poses[k], _lifted(keyframe, keypoints, depths))
        places.update((mine[i], seen[i]) for i in np.flatnonzero(depths).tolist())
    for p in points:
        if p not in places:  # where no image has depth it goes with who saw it first
            k = min(world.points[p].keyframes & poses.keys())
            motion = poses[k] @ inverse(world.keyframes[k].world_from_camera)
            places[p] = transform(motion, world.points[p].position[None])[0]
    return {k: poses[k] for k in free}, places


def _units(world: GlobalMap, keyframes: Sequence[int]) -> float:
    """Map units a metre of these keyframes' depths, which single images say with some scatter."""
    said = [world.keyframes[k].depth_units for k in keyframes]
    known = [units for units in said if units > 0.0]
    return float(np.median(known)) if known else 0.0


def _depths(keyframe: GlobalKeyframe, keypoints: Index, units: float) -> Array:
    """Depths (n,) of keypoints in map units, all images by the same unit; 0 for none."""
    if keyframe.depths is None:
        return np.zeros(len(keypoints))
    own = keyframe.depth_units
    return keyframe.depths[keypoints] * (units / own if own > 0.0 else 1.0)


def _lifted(keyframe: GlobalKeyframe, keypoints: Index, depths: Array) -> Array:
    """Places (n, 3) of keypoints at such depths, in the camera's frame."""
    camera, pixels = keyframe.camera, keyframe.pixels[keypoints]
    x, y = (pixels[:, 0] - camera.cx) / camera.fx, (pixels[:, 1] - camera.cy) / camera.fy
    return np.stack([x, y, np.ones(len(x))], axis=1) * depths[:, None]


def _placed_beside(
    world: GlobalMap, keyframe: GlobalKeyframe, poses: dict[int, Array], units: float
) -> Array | None:
    """The pose (4, 4) of a keyframe by the depths of those that have one and share most points with it."""
    found: list[tuple[int, list[int]]] = []
    for k in poses:
        other = world.keyframes[k]
        if other.depths is not None:
            shared = sorted(keyframe.observed.keys() & other.observed.keys())
            depths = _depths(other, np.array([other.observed[p] for p in shared], np.intp), units)
            shared = [shared[i] for i in np.flatnonzero(depths).tolist()]
            if len(shared) >= LEAST:
                found.append((k, shared))
    if not found:
        return None
    best = sorted(found, key=lambda one: (-len(one[1]), -one[0]))[:BESIDE]
    places, errors, keypoints = [], [], []
    for k, shared in best:
        other = world.keyframes[k]
        theirs = np.array([other.observed[p] for p in shared], np.intp)
        local = _lifted(other, theirs, _depths(other, theirs, units))
        places.append(transform(poses[k], local))
        errors.append(DEPTH_ERROR * local @ poses[k][:3, :3].T)
        keypoints += [keyframe.observed[p] for p in shared]
    nearest = best[0][0]
    start = poses[nearest] @ inverse(world.keyframes[nearest].world_from_camera) @ keyframe.world_from_camera
    estimate = refine_pose(
        keyframe.camera,
        start,
        np.concatenate(places),
        keyframe.pixels[keypoints],
        keyframe.sigmas[keypoints],
        np.concatenate(errors),
    )
    return estimate.world_from_camera
