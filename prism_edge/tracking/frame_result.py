"""What the tracker says of a frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from prism_edge.geometry.poses import Array, inverse
from prism_edge.messages import DEGRADED, OK
from prism_edge.tracking.baseline import shift_as_turn
from prism_edge.tracking.frame_tracking import TrackedFrame
from prism_edge.tracking.local_map import LocalKeyframe

DEGRADED_MATCHES = 50


@dataclass(frozen=True)
class FrameResult:
    """What became of a frame. Lengths are in map units."""

    odometry: str
    world_from_camera: Array | None  # None: nothing to publish
    covariance: Array  # (6, 6), translation first, camera frame
    reference: int  # keyframe that carries the frame, -1 for none
    reference_from_camera: Array
    matched: int
    in_map: bool = True  # False: tracked in a part of the map whose place in it is not known yet
    unobserved: float = 0.0  # standard deviation of the position beside the covariance (baseline.py)
    parallax_deg: float = 1.0  # that the best of its points were placed under (baseline.py)
    shift_as_turn: float = 1.0  # what of a shift its points take for a turn (baseline.py)


def nothing(odometry: str) -> FrameResult:
    """A frame without a pose."""
    return FrameResult(odometry, None, np.zeros((6, 6)), -1, np.eye(4), 0)


def beside(reference: LocalKeyframe, frame: TrackedFrame, in_map: bool) -> FrameResult:
    """A frame that was tracked, placed relative to the keyframe that the camera is at."""
    pose, odometry = frame.world_from_camera, OK if frame.matched >= DEGRADED_MATCHES else DEGRADED
    offset = inverse(reference.world_from_camera) @ pose
    said = odometry, pose, frame.covariance, reference.id, offset, frame.matched, in_map
    alike = shift_as_turn(frame.camera, frame.features.pixels.compress(frame.points >= 0, axis=0))
    return FrameResult(*said, frame.unobserved, frame.parallax_deg, alike)
