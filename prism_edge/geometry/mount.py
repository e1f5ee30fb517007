"""Where the camera sits on the robot."""

from __future__ import annotations

import numpy as np

from prism_edge.config import FramesConfig
from prism_edge.geometry.poses import (
    Array,
    from_rt,
    quaternion_from_rotation,
    rotation_from_quaternion,
    so3_exp,
)

_AHEAD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # base_from_camera, looking along x
LEAST_LEVEL = 0.5  # share of "up" that lies in the image: looking down by 60 degrees there is no upright


def base_from_camera(frames: FramesConfig) -> Array:
    """Pose (4, 4) of the optical camera on the robot, in metres."""
    rotation = rotation_from_quaternion(np.array(frames.base_from_camera_xyzw))
    return from_rt(rotation, np.array(frames.base_from_camera_xyz))


def quarter_turns(base_from_camera: Array) -> int:
    """Counter-clockwise quarter turns, 0 to 3, that bring a camera's pictures nearest to upright.

    ``base_from_camera`` (4, 4) is its mount, z of the base being up. 0 for one that looks down or up steeply.
    """
    right, down = base_from_camera[2, 0], base_from_camera[2, 1]  # "up" in the camera's axes
    if np.hypot(right, down) < LEAST_LEVEL:
        return 0
    return round(float(np.arctan2(right, -down)) / (np.pi / 2)) % 4


def looking(left_deg: float = 0.0, down_deg: float = 0.0, roll_deg: float = 0.0) -> list[float]:
    """``frames.base_from_camera_xyzw`` of a camera that is turned from straight ahead, to four decimals.

    First it is rolled about its own axis, its right side down, then tilted down, then turned to the left.
    """
    roll, down, left = np.radians([roll_deg, down_deg, left_deg])
    turn = so3_exp(np.array([0, 0, left])) @ so3_exp(np.array([0, down, 0])) @ so3_exp(np.array([roll, 0, 0]))
    return [round(float(v), 4) + 0.0 for v in quaternion_from_rotation(turn @ _AHEAD)]


def described(frames: FramesConfig) -> str:
    """The mount in words that show a mistake: where the camera looks, and how high it is."""
    mount = base_from_camera(frames)
    x, y, z = (round(float(v), 2) + 0.0 for v in mount[:3, 2])  # no -0.00
    height = round(float(mount[2, 3]), 3)
    where = "level with" if height == 0.0 else f"{abs(height):g} m {'above' if height > 0 else 'below'}"
    return f"camera looks along {frames.base_link} ({x:.2f}, {y:.2f}, {z:.2f}), {where} it"
