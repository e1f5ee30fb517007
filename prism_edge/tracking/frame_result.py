"""What the tracker says of a frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from prism_edge.geometry.poses import Array


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


def nothing(odometry: str) -> FrameResult:
    """A frame without a pose."""
    return FrameResult(odometry, None, np.zeros((6, 6)), -1, np.eye(4), 0)
