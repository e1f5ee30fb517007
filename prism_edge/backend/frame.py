"""The map's frame stays where most keyframes say it is: an adjustment that turns everything corrects nothing.

Nothing in images says where the world's origin is, so an adjustment holds some pose, the first keyframe's
while the map is young. But that one is as doubtful as any other: held, its errors turn and shift all the
rest, and so every pose published from then on beside those published before.

What is too little to be undone is owed: each keyframe has a reference, where it would be if the frame had
been kept to the last digit. Else the map of a room that is seen for days would creep. What stands in for an
older keyframe has no say: it was placed beside those a moment ago, and as what is off about that is off the
same way each time, they would follow it.
"""

from __future__ import annotations

import numpy as np

from prism_edge.backend.connectivity import hanging_together
from prism_edge.backend.global_map import GlobalKeyframe, GlobalMap
from prism_edge.geometry.alignment import Alignment, DegenerateAlignment, align
from prism_edge.geometry.poses import Array, from_rt, transform

# Map units, which are about metres.
ARM = 2.0  # a keyframe counts with its centre and six points so far from it, as what it sees is
ALIKE = 0.02  # below it displacements count squared, above it by their length: the majority stays
LEAST = 0.001  # a frame that has moved less, anywhere in the map, is left: most windows move few of many
ROUNDS = 10


def keep_frame(world: GlobalMap) -> bool:
    """Move a map rigidly to where its keyframes' references are, on the whole.

    Parts whose place beside each other is not known are kept each by its own keyframes. Returns whether any
    was moved.
    """
    left = {k for k, keyframe in world.keyframes.items() if _is_off(keyframe)}
    moved = False
    while left:
        part = hanging_together(world, min(left))
        moved |= _keep(world, sorted(part))
        left -= part
    return moved


def take_references(world: GlobalMap) -> None:
    """Where keyframes are is where they belong: a loop has put them there."""
    for keyframe in world.keyframes.values():
        keyframe.reference = keyframe.world_from_camera


def _is_off(keyframe: GlobalKeyframe) -> bool:
    return keyframe.world_from_camera is not keyframe.reference


def _keep(world: GlobalMap, part: list[int]) -> bool:
    keyframes = [world.keyframes[k] for k in part]
    heard = [keyframe for keyframe in keyframes if not keyframe.stands_in] or keyframes
    poses = np.array([keyframe.world_from_camera for keyframe in keyframes])
    are = _arms(np.array([keyframe.world_from_camera for keyframe in heard]))
    were = _arms(np.array([keyframe.reference for keyframe in heard]))
    back = majority(are, were) if len(heard) > 1 else None  # one has nothing that it could be compared with
    motion = np.eye(4) if back is None else from_rt(back.rotation, back.translation)
    moved = bool(np.linalg.norm(transform(motion, are) - are, axis=1).max() >= LEAST)
    if moved:
        world.move(motion, set(part))
    for keyframe, pose in zip(keyframes, motion @ poses, strict=True):
        keyframe.reference = keyframe.world_from_camera if moved else pose
    return moved


def majority(source: Array, target: Array) -> Alignment | None:
    """The rigid motion that carries most of ``source`` (n, 3) onto ``target``; None where there is none.

    It minimises the sum of distances (squared below ALIKE) by least squares with ever new weights.
    """
    weights = np.full(len(source), 1.0 / ALIKE)
    found = None
    for _ in range(ROUNDS):
        try:
            found = align(source, target, with_scale=False, weights=weights)
        except DegenerateAlignment:
            return None
        off = np.linalg.norm(found.apply(source) - target, axis=1)
        before, weights = weights, 1.0 / np.maximum(off, ALIKE)
        if np.array_equal(weights, before):  # all are alike, as after most windows
            break
    return found


def _arms(poses: Array) -> Array:
    """Points (7 n, 3) that stand for poses (n, 4, 4): the centre, and both ways along each axis."""
    centre, axes = poses[:, None, :3, 3], ARM * poses[:, :3, :3].transpose(0, 2, 1)
    return np.concatenate([centre, centre + axes, centre - axes], axis=1).reshape(-1, 3)
