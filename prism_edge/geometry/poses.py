"""Rigid poses as 4x4 float64 matrices, named ``a_from_b`` (``a_from_b @ point_in_b = point_in_a``)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Below this angle (rad) sin(x)/x and its kin come from their series, which is exact to rounding there.
_SMALL_ANGLE = 1e-4


def skew(v: Array) -> Array:
    """The 3x3 matrix with ``skew(v) @ w == cross(v, w)``."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def so3_exp(rotation_vector: Array) -> Array:
    """Rotation matrix (3, 3) of a rotation vector (3,) in radians (Rodrigues)."""
    angle2 = float(rotation_vector @ rotation_vector)
    angle = np.sqrt(angle2)
    if angle < _SMALL_ANGLE:
        a, b = 1.0 - angle2 / 6.0, 0.5 - angle2 / 24.0
    else:
        a, b = np.sin(angle) / angle, (1.0 - np.cos(angle)) / angle2
    k = skew(rotation_vector)
    return np.eye(3) + a * k + b * (k @ k)


def so3_log(rotation: Array) -> Array:
    """Rotation vector (3,), of length at most pi, of a rotation matrix (3, 3)."""
    x, y, z, w = quaternion_from_rotation(rotation)
    v = np.array([x, y, z])
    n = float(np.linalg.norm(v))
    if n < 1e-9:
        return 2.0 * v
    return v * (2.0 * np.arctan2(n, w) / n)


def se3_exp(twist: Array) -> Array:
    """Pose (4, 4) of a twist (6,): translation part first (m), then rotation vector (rad)."""
    rho, phi = twist[:3], twist[3:]
    angle2 = float(phi @ phi)
    angle = np.sqrt(angle2)
    if angle < _SMALL_ANGLE:
        b, c = 0.5 - angle2 / 24.0, 1.0 / 6.0 - angle2 / 120.0
    else:
        b, c = (1.0 - np.cos(angle)) / angle2, (angle - np.sin(angle)) / (angle2 * angle)
    k = skew(phi)
    return from_rt(so3_exp(phi), rho + b * (k @ rho) + c * (k @ (k @ rho)))


def se3_log(pose: Array) -> Array:
    """Twist (6,) of a pose (4, 4), the inverse of :func:`se3_exp`."""
    phi = so3_log(pose[:3, :3])
    angle2 = float(phi @ phi)
    angle = np.sqrt(angle2)
    if angle < _SMALL_ANGLE:
        c = 1.0 / 12.0 + angle2 / 720.0
    else:
        c = 1.0 / angle2 - (1.0 + np.cos(angle)) / (2.0 * angle * np.sin(angle))
    k = skew(phi)
    t = pose[:3, 3]
    return np.concatenate([t - 0.5 * (k @ t) + c * (k @ (k @ t)), phi])


def from_rt(rotation: Array, translation: Array) -> Array:
    """Pose (4, 4) from a rotation (3, 3) and a translation (3,)."""
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = translation
    return pose


def inverse(pose: Array) -> Array:
    """Inverse of one rigid pose (4, 4) or of a stack (..., 4, 4)."""
    rotation_t = np.swapaxes(pose[..., :3, :3], -1, -2)
    out = np.zeros_like(pose)
    out[..., :3, :3] = rotation_t
    out[..., :3, 3] = -(rotation_t @ pose[..., :3, 3:])[..., 0]
    out[..., 3, 3] = 1.0
    return out


def transform(pose: Array, points: Array) -> Array:
    """Points (n, 3) carried by ``a_from_b`` from frame b to frame a."""
    return points @ pose[:3, :3].T + pose[:3, 3]


def scaled(pose: Array, factor: float) -> Array:
    """The pose with its translation multiplied by ``factor`` (a change of the unit of length)."""
    out = pose.copy()
    out[..., :3, 3] *= factor
    return out


def normalised(pose: Array) -> Array:
    """The nearest rigid pose: long products of rotations drift off the group by rounding."""
    u, _, vt = np.linalg.svd(pose[:3, :3])
    return from_rt(u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt, pose[:3, 3])


def quaternion_from_rotation(rotation: Array) -> Array:
    """Unit quaternion (x, y, z, w) with w >= 0 of a rotation matrix (3, 3); stable at every angle."""
    m = rotation
    # The largest of the four squared components is the safe one to divide by (Shepperd's method).
    squares = np.array(
        [
            1.0 + m[0, 0] - m[1, 1] - m[2, 2],
            1.0 - m[0, 0] + m[1, 1] - m[2, 2],
            1.0 - m[0, 0] - m[1, 1] + m[2, 2],
            1.0 + m[0, 0] + m[1, 1] + m[2, 2],
        ]
    )
    i = int(np.argmax(squares))
    if i == 3:
        q = np.array([m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1], squares[3]])
    elif i == 0:
        q = np.array([squares[0], m[0, 1] + m[1, 0], m[0, 2] + m[2, 0], m[2, 1] - m[1, 2]])
    elif i == 1:
        q = np.array([m[0, 1] + m[1, 0], squares[1], m[1, 2] + m[2, 1], m[0, 2] - m[2, 0]])
    else:
        q = np.array([m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], squares[2], m[1, 0] - m[0, 1]])
    q /= np.linalg.norm(q)
    return q if q[3] >= 0.0 else -q


def rotation_from_quaternion(quaternion: Array) -> Array:
    """Rotation matrix (3, 3) of a quaternion (x, y, z, w) of any nonzero length."""
    x, y, z, w = np.asarray(quaternion, dtype=np.float64) / np.linalg.norm(quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def rotation_angle(rotation: Array) -> float:
    """Angle (rad) in [0, pi] of a rotation matrix (3, 3)."""
    return float(np.linalg.norm(so3_log(rotation)))
