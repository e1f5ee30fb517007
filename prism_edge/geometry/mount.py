"""Where the camera sits on the robot."""

from __future__ import annotations

import numpy as np

from prism_edge.config import FramesConfig
from prism_edge.geometry.poses import Array, from_rt, rotation_from_quaternion


def base_from_camera(frames: FramesConfig) -> Array:
    """Pose (4, 4) of the optical camera on the robot, in metres."""
    rotation = rotation_from_quaternion(np.array(frames.base_from_camera_xyzw))
    return from_rt(rotation, np.array(frames.base_from_camera_xyz))
