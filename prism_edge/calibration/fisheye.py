"""A fisheye's projection with its derivatives, for rays beyond 90 degrees off the axis too.

OpenCV's (``cv2.fisheye.projectPoints``) divides by z, and so takes a point behind the plane of the lens for
one mirrored at it. The images of lenses that see 180 degrees have corners there.
"""

from __future__ import annotations

import cv2
import numpy as np

from prism_edge.geometry.cameras import Camera
from prism_edge.geometry.poses import Array

_NEAREST = 1e-12  # of a point to the optical axis


def project(points: Array, rotation: Array, translation: Array, camera: Camera) -> tuple[Array, Array]:
    """Pixels (n, 2) of board points (n, 3) under a rotation vector (3,) and a translation (3,).

    Second their derivative (n, 2, 14): rotation vector, translation, fx fy cx cy, k1 to k4. The angle off the
    axis becomes d = a (1 + k1 a^2 + k2 a^4 + k3 a^6 + k4 a^8), a pixel is at focal length times d.
    """
    turn, by_vector = cv2.Rodrigues(np.asarray(rotation, np.float64).ravel())
    seen = points @ turn.T + np.ravel(translation)
    x, y, z = seen.T
    across = np.maximum(np.hypot(x, y), _NEAREST)
    angle = np.arctan2(across, z)
    powers = angle[:, None] ** np.arange(3, 10, 2)  # of k1 to k4
    reach = angle + powers @ camera.distortion
    slope = 1.0 + (powers / angle[:, None] * np.arange(3, 10, 2)) @ camera.distortion  # d reach / d angle
    share, distance = reach / across, across**2 + z**2
    share_by_across = (slope * z / distance * across - reach) / across**2
    share_by_seen = np.column_stack(
        [share_by_across * x / across, share_by_across * y / across, -slope / distance]
    )
    # Row k of OpenCV's derivative is that of the matrix, row by row, by the vector's k-th component.
    seen_by_vector = np.einsum("kij,nj->nik", by_vector.reshape(3, 3, 3), points)
    focal = np.array([camera.fx, camera.fy])
    pixels = focal * share[:, None] * seen[:, :2] + (camera.cx, camera.cy)
    slopes = np.zeros((len(points), 2, 14))
    for axis in (0, 1):
        by_seen = seen[:, axis, None] * share_by_seen
        by_seen[:, axis] += share
        slopes[:, axis, :3] = focal[axis] * np.einsum("ni,nik->nk", by_seen, seen_by_vector)
        slopes[:, axis, 3:6] = focal[axis] * by_seen
        slopes[:, axis, 6 + axis] = share * seen[:, axis]
        slopes[:, axis, 8 + axis] = 1.0
        slopes[:, axis, 10:] = focal[axis] * (seen[:, axis] / across)[:, None] * powers
    return pixels, slopes
