"""Where a camera sees points of the map: at which pixels, and on which level of its pyramid."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from prism_edge.geometry.cameras import Camera
from prism_edge.geometry.field_of_view import in_image
from prism_edge.geometry.poses import Array
from prism_edge.tracking.point_table import Index, PointTable


def project(camera: Camera, pose: Array, points: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Ideal pixels (n, 2) of world points and which are in the image; ``pose`` is world_from_camera."""
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    z = local[:, 2]
    front = z > 1e-3
    inverse_z = 1.0 / np.where(front, z, 1.0)
    pixels = np.empty((len(points), 2))
    pixels[:, 0] = camera.fx * local[:, 0] * inverse_z + camera.cx
    pixels[:, 1] = camera.fy * local[:, 1] * inverse_z + camera.cy
    return pixels, front & in_image(camera, pixels)


def expected_octaves(table: PointTable, rows: Index, distance: Array, factors: Array) -> Array:
    """Pyramid levels (n,), whole numbers, on which points look as they did when last seen; some don't exist.

    A point that is as much farther as levels are apart, by their scale ``factors``, is found a level lower.
    """
    log_factor = float(np.log(factors[1])) if len(factors) > 1 else 1.0
    shrunk = np.log(table.distance.take(rows) / distance) / log_factor
    octaves: Array = np.rint(shrunk) + table.octave.take(rows)
    return octaves
