"""Where a window on new ground might begin instead: from the network's depths, or from its mirror image.

A camera that turns quickly and moves little sees a turn one way and a step the other nearly alike. A map that
took the one for the other goes on to place new points by it, and soon fits what it sees in a valley of its
own, metres from the truth and with every pixel explained; no solver leaves it. The depths of single images
know nothing of that: by them one keyframe after the other is placed beside others, roughly but in the right
valley, and a window solved from there may fit the same pixels clearly better (window.py).

Nor does a map leave the valley that has near and far exchanged (Necker's cube: through a narrow view a scene
and its mirror image in depth, gone by the other way, look alike). There what is mirrored is the better start.
"""

from __future__ import annotations

from collections.abc import Sequence, Set

import numpy as np

from prism_edge.backend.global_map import GlobalKeyframe, GlobalMap
from prism_edge.geometry.poses import Array, inverse, transform
from prism_edge.tracking.depth_alignment import order
from prism_edge.tracking.point_table import TRIANGULATED_DEG, Index
from prism_edge.tracking.pose_refinement import refine_pose
from prism_edge.tracking.triangulation import rays

LEAST = 20  # points with depth that a keyframe shares with another, to be placed beside it
BESIDE = 2  # others that it is placed beside
DEPTH_ERROR = 0.1  # relative, of a network's depths within an image
FARTHEST = 4.0  # times the middle depth: what a point's mirror image is away at most
WITNESSES = 3  # keyframes that say which way round near and far are
LESS, SHARE = 2.0, 0.01  # of the cost (nats, and of the whole) that a window takes a second start for


Start = tuple[dict[int, Array], dict[int, Array]]  # poses and places


def clearly_less(cost: float, before: float) -> bool:
    """Whether what a window costs is less than ``before`` by more than the noise of a solver that stops."""
    return before - cost > max(LESS, SHARE * before)


def is_exchanged(world: GlobalMap, poses: dict[int, Array], places: dict[int, Array]) -> bool:
    """Whether near and far are rather the other way round than networks have them in these keyframes.

    ``poses`` (4, 4) of the keyframes, ``places`` (3,) of points. A network that is wrong by any factor still
    tells near from far.
    """
    depths = of_network(world, list(poses), 1.0, as_laid=False)
    said = []
    for k, pose in poses.items():
        observed = world.keyframes[k].observed
        seen = [p for p in observed if p in places and world.points[p].parallax_deg >= TRIANGULATED_DEG]
        told = depths[k][[observed[p] for p in seen]] if seen else np.zeros(0)
        along = (np.array([places[p] for p in seen]).reshape(-1, 3) - pose[:3, 3]) @ pose[:3, 2]
        known = (told > 0.0) & (along > 0.0)
        alike = order(along[known], told[known])
        said += [] if alike is None else [alike]
    return len(said) >= WITNESSES and sum(said) < 0.0


def second_start(
    world: GlobalMap,
    held: Sequence[int],
    free: Sequence[int],
    points: Sequence[int],
    pinned: Set[int],
    depths: dict[int, Array],
) -> Start | None:
    """Poses (4, 4) of the ``free`` keyframes and places (3,) of the points; None where depth can't give them.

    The held keyframes stay where they are, and the ``pinned`` points. ``depths`` (n,) are of each keyframe's
    keypoints (:func:`of_network`, :func:`mirrored`), map units, 0 for none.
    """
    poses = {k: world.keyframes[k].world_from_camera for k in held}
    ties = _ties(world, depths)
    waiting = set(free)
    while waiting:  # next is who shares most with those that have a place
        near = {k: sorted(t for t in ties[k] if t[1] in poses)[-BESIDE:] for k in waiting}
        k = max(sorted(waiting), key=lambda k: near[k][-1:])
        if not near[k]:
            return None
        poses[k] = _placed_beside(world, world.keyframes[k], poses, depths, [other for _, other in near[k]])
        waiting.remove(k)
    return {k: poses[k] for k in free}, _places(world, points, pinned, poses, depths)


def of_network(
    world: GlobalMap, keyframes: Sequence[int], units_per_metre: float, as_laid: bool = True
) -> dict[int, Array]:
    """Depths (n,) of the keyframes' keypoints as networks have them, in map units; 0 for none.

    ``units_per_metre``: where no image's depth has been laid on the map, or (``as_laid`` false) on points
    that are of the wrong size.
    """
    units = (as_laid and _units(world, keyframes)) or units_per_metre
    return {k: _depths(world.keyframes[k], units) for k in keyframes}


def mirrored(world: GlobalMap, keyframes: Sequence[int], points: Sequence[int]) -> dict[int, Array]:
    """Depths (n,) of the keyframes' keypoints as the map has them, but near for far; 0 for none.

    Inverse depths are mirrored at their median, to FARTHEST times what that is the depth of at most: then the
    other way, and a turn with it, moves the pixels as this one does.
    """
    among = set(points)
    depths = {k: np.zeros(len(world.keyframes[k].pixels)) for k in keyframes}
    for k in keyframes:
        keyframe = world.keyframes[k]
        seen = {p: keypoint for p, keypoint in keyframe.observed.items() if p in among}
        places = np.array([world.points[p].position for p in seen]).reshape(-1, 3)
        along = (places - keyframe.world_from_camera[:3, 3]) @ keyframe.world_from_camera[:3, 2]
        before = along > 0.0
        if before.any():
            near = 1.0 / along[before]
            middle = float(np.median(near))
            keypoints = np.array(list(seen.values()), np.intp)[before]
            depths[k][keypoints] = 1.0 / np.maximum(2.0 * middle - near, middle / FARTHEST)
    return depths


def _units(world: GlobalMap, keyframes: Sequence[int]) -> float:
    """Map units a metre of these keyframes' depths, the median; 0 where no image says."""
    known = [units for k in keyframes if (units := world.keyframes[k].depth_units) > 0.0]
    return float(np.median(known)) if known else 0.0


def _depths(keyframe: GlobalKeyframe, units: float) -> Array:
    """Depths (n,) of its keypoints in map units, all images by the same unit; 0 for none."""
    if keyframe.depths is not None:
        own = keyframe.depth_units
        return keyframe.depths * (units / own) if own > 0.0 else keyframe.depths
    return np.zeros(len(keyframe.pixels)) if keyframe.unfitting is None else keyframe.unfitting * units


def _ties(world: GlobalMap, depths: dict[int, Array]) -> dict[int, list[tuple[int, int]]]:
    """Of each keyframe the others that could place it: (how many deep points of theirs it sees, other)."""
    deep = {}
    for k, of_keypoints in depths.items():
        observed = world.keyframes[k].observed
        points, keypoints = np.array(list(observed), np.int64), np.array(list(observed.values()), np.intp)
        deep[k] = set(points[of_keypoints[keypoints] > 0.0].tolist())
    ties: dict[int, list[tuple[int, int]]] = {}
    for k in depths:
        seen = world.keyframes[k].observed.keys()
        counts = [(len(seen & theirs), n) for n, theirs in deep.items() if n != k]
        ties[k] = [tie for tie in counts if tie[0] >= LEAST]
    return ties


def _lifted(keyframe: GlobalKeyframe, keypoints: Index, depths: Array) -> Array:
    """Places (n, 3) of keypoints at such depths, in the camera's frame."""
    return rays(keyframe.camera, keyframe.pixels[keypoints]) * depths[:, None]


def _placed_beside(
    world: GlobalMap,
    keyframe: GlobalKeyframe,
    poses: dict[int, Array],
    depths: dict[int, Array],
    near: list[int],
) -> Array:
    """The pose (4, 4) of a keyframe by the depths of others, of which the last shares most points with it."""
    places, errors, keypoints = [], [], []
    for k in near:
        other = world.keyframes[k]
        shared = sorted(keyframe.observed.keys() & other.observed.keys())
        theirs = np.array([other.observed[p] for p in shared], np.intp)
        local = _lifted(other, theirs, depths[k][theirs])
        known = local[:, 2] > 0.0
        places.append(transform(poses[k], local[known]))
        errors.append(DEPTH_ERROR * local[known] @ poses[k][:3, :3].T)
        keypoints += [keyframe.observed[shared[i]] for i in np.flatnonzero(known).tolist()]
    nearest = near[-1]
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


def _places(
    world: GlobalMap,
    points: Sequence[int],
    pinned: Set[int],
    poses: dict[int, Array],
    depths: dict[int, Array],
) -> dict[int, Array]:
    """Where points are by the first who has a depth for them; where nobody has, they go with who saw them."""
    places = {p: world.points[p].position for p in pinned}
    for k in sorted(poses):
        keyframe = world.keyframes[k]
        mine = [p for p in points if p not in places and p in keyframe.observed]
        keypoints = np.array([keyframe.observed[p] for p in mine], np.intp)
        seen = transform(poses[k], _lifted(keyframe, keypoints, depths[k][keypoints]))
        places.update((mine[i], seen[i]) for i in np.flatnonzero(depths[k][keypoints] > 0.0).tolist())
    for p in points:
        if p not in places:
            k = min(world.points[p].keyframes & poses.keys())
            motion = poses[k] @ inverse(world.keyframes[k].world_from_camera)
            places[p] = transform(motion, world.points[p].position[None])[0]
    return places
