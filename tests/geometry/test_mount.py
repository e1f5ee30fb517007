"""The camera's pose on the robot, as it is configured."""

from __future__ import annotations

import numpy as np

from prism_edge.config import FramesConfig
from prism_edge.geometry.mount import base_from_camera


def test_by_default_the_camera_looks_along_the_robots_x_axis() -> None:
    mount = base_from_camera(FramesConfig(base_from_camera_xyz=(0.1, 0.2, 0.3)))
    ahead, right, below = np.array([0, 0, 2.0, 1]), np.array([1.0, 0, 0, 1]), np.array([0, 1.0, 0, 1])
    np.testing.assert_allclose(mount @ ahead, [2.1, 0.2, 0.3, 1], atol=1e-12)
    np.testing.assert_allclose(mount @ right, [0.1, -0.8, 0.3, 1], atol=1e-12)
    np.testing.assert_allclose(mount @ below, [0.1, 0.2, -0.7, 1], atol=1e-12)
