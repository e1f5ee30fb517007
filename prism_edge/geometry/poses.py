"""Rigid poses as 4x4 float64 matrices, named ``a_from_b`` (``a_from_b @ point_in_b = point_in_a``)."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Below this angle (rad) sin(x)/x and its kin come from their series, which is exact to rounding there.
_SMALL_ANGLE = 1e-4
_IDENTITY = np.eye(3)
_HERE = np.eye(4)  # copied, which takes a quarter of the time of making one
_NEARLY_RIGID = 1e-8


def skew(v: Array) -> Array:
    """The 3x3 matrix with ``skew(v) @ w == cross(v, w)``."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def so3_exp(rotation_vector: Array) -> Array:
    """Rotation matrix (3, 3) of a rotation vector (3,) in radians (Rodrigues)."""
    # Plain numbers: a dozen numpy calls on three elements would cost ten times as much.
    x, y, z = float(rotation_vector[0]), float(rotation_vector[1]), float(rotation_vector[2])
    xx, yy, zz = x * x, y * y, z * z
    angle2 = xx + yy + zz
    angle = math.sqrt(angle2)
    if angle < _SMALL_ANGLE:
        a, b = 1.0 - angle2 / 6.0, 0.5 - angle2 / 24.0
    else:
        a, b = math.sin(angle) / angle, (1.0 - math.cos(angle)) / angle2
    ax, ay, az, bxy, bxz, byz = a * x, a * y, a * z, b * x * y, b * x * z, b * y * z
    return np.array(
        [
            [1.0 - b * (yy + zz), bxy - az, bxz + ay],
            [bxy + az, 1.0 - b * (xx + zz), byz - ax],
            [bxz - ay, byz + ax, 1.0 - b * (xx + yy)],
        ]
    )


def so3_log(rotation: Array) -> Array:
    """Rotation vector (3,), of length at most pi, of a rotation matrix (3, 3)."""
    return np.array(_rotation_vector(rotation))


def _rotation_vector(rotation: Array) -> tuple[float, float, float]:
    x, y, z, w = _quaternion(rotation)
    n = math.sqrt(x * x + y * y + z * z)
    k = 2.0 if n < 1e-9 else 2.0 * math.atan2(n, w) / n
    return k * x, k * y, k * z


def se3_exp(twist: Array) -> Array:
    """Pose (4, 4) of a twist (6,): translation part first (m), then rotation vector (rad)."""
    phi = twist[3:]
    px, py, pz = float(phi[0]), float(phi[1]), float(phi[2])
    x, y, z = float(twist[0]), float(twist[1]), float(twist[2])
    angle2 = px * px + py * py + pz * pz
    angle = math.sqrt(angle2)
    if angle < _SMALL_ANGLE:
        b, c = 0.5 - angle2 / 24.0, 1.0 / 6.0 - angle2 / 120.0
    else:
        b, c = (1.0 - math.cos(angle)) / angle2, (angle - math.sin(angle)) / (angle2 * angle)
    # cross(phi, rho) and cross(phi, cross(phi, rho))
    ux, uy, uz = py * z - pz * y, pz * x - px * z, px * y - py * x
    vx, vy, vz = py * uz - pz * uy, pz * ux - px * uz, px * uy - py * ux
    pose = _HERE.copy()
    pose[:3, :3] = so3_exp(phi)
    pose[:3, 3] = (x + b * ux + c * vx, y + b * uy + c * vy, z + b * uz + c * vz)
    return pose


def se3_log(pose: Array) -> Array:
    """Twist (6,) of a pose (4, 4), the inverse of :func:`se3_exp`."""
    px, py, pz = _rotation_vector(pose[:3, :3])
    x, y, z = pose[:3, 3].tolist()
    angle2 = px * px + py * py + pz * pz
    angle = math.sqrt(angle2)
    if angle < _SMALL_ANGLE:
        c = 1.0 / 12.0 + angle2 / 720.0
    else:
        c = 1.0 / angle2 - (1.0 + math.cos(angle)) / (2.0 * angle * math.sin(angle))
    # cross(phi, t) and cross(phi, cross(phi, t))
    ux, uy, uz = py * z - pz * y, pz * x - px * z, px * y - py * x
    vx, vy, vz = py * uz - pz * uy, pz * ux - px * uz, px * uy - py * ux
    return np.array([x - 0.5 * ux + c * vx, y - 0.5 * uy + c * vy, z - 0.5 * uz + c * vz, px, py, pz])


def from_rt(rotation: Array, translation: Array) -> Array:
    """Pose (4, 4) from a rotation (3, 3) and a translation (3,)."""
    pose = _HERE.copy()
    pose[:3, :3] = rotation
    pose[:3, 3] = translation
    return pose


def inverse(pose: Array) -> Array:
    """Inverse of one rigid pose (4, 4) or of a stack (..., 4, 4)."""
    if pose.ndim == 2:
        turned_back = pose[:3, :3].T
        return from_rt(turned_back, -(turned_back @ pose[:3, 3:])[:, 0])
    rotation_t = np.swapaxes(pose[..., :3, :3], -1, -2)
    out = np.zeros_like(pose)
    out[..., :3, :3] = rotation_t
    out[..., :3, 3] = -(rotation_t @ pose[..., :3, 3:])[..., 0]
    out[..., 3, 3] = 1.0
    return out


def adjoint(pose: Array) -> Array:
    """(6, 6): turns a twist (6,) in the axes of ``b`` to the same motion in those of ``a`` (``a_from_b``)."""
    out = np.zeros((6, 6))
    out[:3, :3] = out[3:, 3:] = pose[:3, :3]
    out[:3, 3:] = skew(pose[:3, 3]) @ pose[:3, :3]  # what turns about b's origin swings a's
    return out


def swung(covariance: Array, arm: Array) -> Array:
    """Covariance (6, 6) of the pose of a point that is ``arm`` (3) away on the same body; same axes."""
    carry = adjoint(from_rt(np.eye(3), -arm))
    return np.asarray(carry @ covariance @ carry.T)


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
    rotation = pose[:3, :3]
    excess = rotation.T @ rotation - _IDENTITY
    if np.abs(excess).max() < _NEARLY_RIGID:
        # Newton's step of the polar decomposition: its error is the square of what is small already.
        return from_rt(rotation - 0.5 * (rotation @ excess), pose[:3, 3])
    u, _, vt = np.linalg.svd(rotation)
    return from_rt(u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt, pose[:3, 3])


def quaternion_from_rotation(rotation: Array) -> Array:
    """Unit quaternion (x, y, z, w) with w >= 0 of a rotation matrix (3, 3); stable at every angle."""
    return np.array(_quaternion(rotation))


def _quaternion(rotation: Array) -> tuple[float, float, float, float]:
    (a, b, c), (d, e, f), (g, h, i) = rotation.tolist()
    # The largest of the four squared components is the safe one to divide by (Shepperd's method).
    xx, yy, zz, ww = 1.0 + a - e - i, 1.0 - a + e - i, 1.0 - a - e + i, 1.0 + a + e + i
    largest = max(xx, yy, zz, ww)
    if largest == ww:
        x, y, z, w = h - f, c - g, d - b, ww
    elif largest == xx:
        x, y, z, w = xx, b + d, c + g, h - f
    elif largest == yy:
        x, y, z, w = b + d, yy, f + h, c - g
    else:
        x, y, z, w = c + g, f + h, zz, d - b
    n = math.copysign(math.sqrt(x * x + y * y + z * z + w * w), w)
    return x / n, y / n, z / n, w / n


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


def are_rotations(matrices: Array, tolerance: float) -> bool:
    """Whether R R^T of each (..., 3, 3) is the identity, elements to ``tolerance``, and none reflects."""
    products = matrices @ np.swapaxes(matrices, -1, -2)
    square = (np.abs(products - _IDENTITY) <= tolerance).all()  # which no NaN is
    return bool(square and (np.linalg.det(matrices) > 0.0).all())


def rotation_angle(rotation: Array) -> float:
    """Angle (rad) in [0, pi] of a rotation matrix (3, 3)."""
    return float(np.linalg.norm(so3_log(rotation)))
