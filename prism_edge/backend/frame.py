"""The map's frame stays where most keyframes say it is: an adjustment that turns everything corrects nothing.

Nothing in images says where the world's origin is, so an adjustment holds some pose, the first keyframe's
while the map is young. But that one is as doubtful as any other: held, its errors turn and shift all the
rest, and so every pose published from then on beside those published before.
"""

from __future__ import annotations

import numpy as np

from prism_edge.backend.global_map import GlobalMap
from prism_edge.geometry.alignment import Alignment, DegenerateAlignment, align
from prism_edge.geometry.poses import Array, from_rt

# Map units, which are about metres.
ARM = 2.0  # a keyframe counts with its centre and six points so far from it, as what it sees is
ALIKE = 0.02  # below it displacements count squared, above it by their length: the majority stays
LEAST = 0.001  # a frame that has moved less, anywhere in the map, is left: most windows move few of many
ROUNDS = 10


def keep_frame(world: GlobalMap, before: dict[int, Array]) -> bool:
    """Move a map rigidly to where its keyframes were ``before`` an adjustment, on the whole.

    ``before`` has world_from_camera (4, 4) of each. Parts whose place beside each other is not known are kept
    each by its own keyframes. Returns whether any was moved.
    """
    common = before.keys() & world.keyframes.keys()
    left = {k for k in common if world.keyframes[k].world_from_camera is not before[k]}
    moved = False
    while left:
        part = hanging_together(world, min(left))
        moved |= _keep(world, part, {k: before[k] for k in sorted(part & common)})
        left -= part
    return moved


def hanging_together(world: GlobalMap, keyframe: int) -> set[int]:
    """A keyframe and all that shares points with it, or with others that do."""
    found, fresh = {keyframe}, [keyframe]
    while fresh and len(found) < len(world.keyframes):
        seen = (world.points[p].keyframes for p in world.keyframes[fresh.pop()].observed)
        new = set().union(*seen) - found
        found |= new
        fresh += sorted(new)
    return found


def _keep(world: GlobalMap, part: set[int], before: dict[int, Array]) -> bool:
    if len(before) < 2:
        return False
    were = _arms(np.array(list(before.values())))
    are = _arms(np.array([world.keyframes[k].world_from_camera for k in before]))
    if np.abs(are - were).max() < LEAST:
        return False
    back = majority(are, were)
    if back is None or np.linalg.norm(back.apply(are) - are, axis=1).max() < LEAST:
        return False
    world.move(from_rt(back.rotation, back.translation), part)
    return True


def majority(source: Array, target: Array) -> Alignment | None:
    """The rigid motion that carries most of ``source`` (n, 3) onto ``target``; None where there is none.

    It minimises the sum of distances (squared below ALIKE) by least squares with ever new weights.
    """
    weights = np.ones(len(source))
    found = None
    for _ in range(ROUNDS):
        try:
            found = align(source, target, with_scale=False, weights=weights)
        except DegenerateAlignment:
            return None
        weights = 1.0 / np.maximum(np.linalg.norm(found.apply(source) - target, axis=1), ALIKE)
    return found


def _arms(poses: Array) -> Array:
    """Points (7 n, 3) that stand for poses (n, 4, 4): the centre, and both ways along each axis."""
    centre, axes = poses[:, None, :3, 3], ARM * poses[:, :3, :3].transpose(0, 2, 1)
    return np.concatenate([centre, centre + axes, centre - axes], axis=1).reshape(-1, 3)
