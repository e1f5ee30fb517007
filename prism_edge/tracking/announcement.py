"""A keyframe as the other processes hear of it."""

from __future__ import annotations

import numpy as np

from prism_edge.geometry.poses import Array
from prism_edge.messages import Frame, Keyframe, KeyframeImage
from prism_edge.tracking.local_map import Changes, LocalKeyframe
from prism_edge.tracking.point_trust import trust
from prism_edge.tracking.tracker import Tracker


def picture_message(frame: Frame, number: int, epoch: int, turns: int = 0) -> KeyframeImage:
    """What the depth network is shown: a frame, as keyframe ``number`` or below 0 as a probe.

    ``turns`` counter-clockwise quarter turns set it upright.
    """
    lens = frame.camera_model, frame.camera
    return KeyframeImage(number, frame.index, frame.stamp_ns, epoch, frame.colour, *lens, frame.image, turns)


def keyframe_message(
    tracker: Tracker, keyframe: LocalKeyframe, travelled: float = 0.0, mount: Array | None = None
) -> Keyframe:
    """The message for a new keyframe, with every change of the map since the one before.

    ``mount`` (4, 4) is the camera's on the robot that began the map; None: the camera is the robot.
    """
    world, changes = tracker.world, tracker.world.changes
    world.changes = Changes()
    world.announced = keyframe.id
    table = world.points
    keypoints, depths = world.depths_in(keyframe)
    all_depths = np.zeros(len(keyframe.points), np.float32)
    all_depths[keypoints] = depths
    parallax = np.zeros(len(keyframe.points), np.float32)
    rows = table.rows(keyframe.points[keypoints])
    parallax[keypoints] = table.parallax_deg[rows]
    trusted = np.zeros(len(keyframe.points), np.float32)
    trusted[keypoints] = trust(table, rows, keyframe.stamp_ns, tracker.proven_after_s)
    new = np.concatenate([*changes.new_points, np.zeros(0, np.int64)])
    new = np.unique(new[table.known(new)])
    into = dict(changes.fused)
    # Some observations were taken back, or lost to another of a fused point, before they were told.
    survivors = ((_survivor(p, into), k, i) for p, k, i in changes.late if k != keyframe.id)
    holds = [(p, k, i) for p, k, i in survivors if k in world.keyframes and world.keyframes[k].points[i] == p]
    late = np.array(holds, np.int64).reshape(-1, 3)
    fused = np.array(changes.fused, np.int64).reshape(-1, 2)
    anchor = max((k for k in world.keyframes if k < keyframe.id), default=keyframe.id)
    joined = np.array(tracker.parts.take_joined(), np.float64).reshape(-1, 4)
    return Keyframe(
        id=keyframe.id,
        index=keyframe.index,
        stamp_ns=keyframe.stamp_ns,
        epoch=tracker.epoch,
        camera_model=keyframe.camera.model,
        camera=keyframe.camera.to_array(),
        world_from_camera=keyframe.world_from_camera,
        pixels=keyframe.features.pixels.astype(np.float32),
        octaves=keyframe.features.octaves.astype(np.uint8),
        descriptors=keyframe.features.descriptors.view(np.uint8).reshape(-1, 32),
        points=keyframe.points,
        depths=all_depths,
        parallax_deg=parallax,
        trust=trusted,
        new_points=new,
        new_positions=table.position[table.rows(new)],
        new_by=table.reference[table.rows(new)],
        late_points=late[:, 0],
        late_keyframes=late[:, 1],
        late_keypoints=late[:, 2],
        culled_points=np.concatenate([*changes.culled_points, np.zeros(0, np.int64)]),
        culled_keyframes=np.array(changes.culled_keyframes, np.int64),
        fused_from=fused[:, 0],
        fused_into=fused[:, 1],
        anchor=anchor,
        world_from_anchor=world.keyframes[anchor].world_from_camera,
        travelled=travelled,
        log_scale=tracker.log_scale,
        scale_factor=tracker.scale_factor,
        stands_in=keyframe.stands_in,
        part=tracker.parts.of(keyframe.id),
        kept=np.array(sorted(world.keyframes), np.int64),
        joined=joined[:, :2].astype(np.int64),
        joined_units=joined[:, 2:],
        twist=keyframe.twist,
        readout_ms=tracker.shutter.readout_ms,
        readout_said=tracker.shutter.is_said,
        base_from_camera=np.eye(4) if mount is None else mount,
    )


def _survivor(point: int, fused_into: dict[int, int]) -> int:
    """The point that took over an identity, through any number of fusions."""
    while point in fused_into:
        point = fused_into[point]
    return point
