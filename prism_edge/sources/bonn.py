"""BONN's truth: its groundtruth.txt holds the pose of the sensor's markers, in the axes of ROS."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from prism_edge.geometry.poses import Array, from_rt

# As published with the dataset (https://www.ipb.uni-bonn.de/data/rgbd-dynamic-dataset/).
_ROS = np.array([[-1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
_PUBLISHED = np.array(
    [
        [1.0157, 0.1828, -0.2389, 0.0113],
        [0.0009, -0.8431, -0.6413, -0.0098],
        [-0.3009, 0.6147, -0.8085, 0.0111],
    ]
)
# That matrix carries a scale of 1.059, which no pose has: its nearest rotation is taken.
_U, _, _VT = np.linalg.svd(_PUBLISHED[:, :3])
_MARKERS_FROM_CAMERA = from_rt(_U @ _VT, _PUBLISHED[:, 3])


def holds_markers(folder: Path) -> bool:
    """Whether a TUM layout is BONN's, by its own name or that of what it is a link to: rgbd_bonn_*."""
    names = (os.path.basename(os.path.abspath(folder)), folder.resolve().name)
    return any(name.lower().startswith("rgbd_bonn_") for name in names)


def camera_from_markers(world_from_markers: Array) -> Array:
    """Poses (..., 4, 4), metres, of the optical camera, of what groundtruth.txt says; the world is turned."""
    return _ROS @ world_from_markers @ _ROS @ _MARKERS_FROM_CAMERA
