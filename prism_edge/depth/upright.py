"""Pictures set upright for a network, where the robot carries its camera upside down or on its side.

A network has learnt from pictures whose floor is below. One that hangs from a ceiling shows it the floor
above, and its metres are worth less.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from prism_edge.depth.prediction import Prediction
from prism_edge.depth.shown_otherwise import ShownOtherwise
from prism_edge.geometry.cameras import Camera
from prism_edge.geometry.poses import Array

if TYPE_CHECKING:
    from prism_edge.depth import DepthNetwork


class UprightNetwork(ShownOtherwise):
    """A network that is shown pictures after so many quarter turns, and whose depths are turned back."""

    def __init__(self, network: DepthNetwork, turns: int) -> None:
        super().__init__(network, f"+{90 * turns}")
        self._turns = turns

    def infer(self, rgb: NDArray[np.uint8], camera: Camera) -> Prediction:
        """Metric depth of an image (height, width, 3) uint8 RGB that ``camera`` took, by its own pixels."""
        upright = np.ascontiguousarray(np.rot90(rgb, self._turns))
        answer = self._network.infer(upright, turned_camera(camera, self._turns))
        return turned_back(answer, self._turns, camera)


def turned_camera(camera: Camera, turns: int) -> Camera:
    """The camera that would have taken the picture after ``turns`` quarter turns, without its distortion."""
    width, height, fx, fy, cx, cy = camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy
    for _ in range(turns):
        width, height, fx, fy, cx, cy = height, width, fy, fx, cy, width - 1 - cx
    return Camera(width, height, fx, fy, cx, cy)


def camera_from_turned(turns: int) -> Array:
    """Pose (4, 4) of that camera in the frame of the one that took the picture."""
    camera_from_quarter = np.array([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    return np.linalg.matrix_power(camera_from_quarter, turns)


def turned_back(prediction: Prediction, turns: int, camera: Camera) -> Prediction:
    """What a network said of ``camera``'s picture after ``turns`` quarter turns, of the picture as it was."""
    depth, confidence = (np.rot90(x, -turns) for x in (prediction.depth, prediction.confidence))
    a, b, c, d = prediction.image_to_depth
    height, width = prediction.depth.shape
    across, down = turned_camera(camera, turns).width, turned_camera(camera, turns).height
    for _ in range(turns):  # a clockwise quarter turn: x is what was down, from the other end
        a, b, c, d = c, height - 1 - d - c * (down - 1), a, b
        height, width, across, down = width, height, down, across
    return replace(
        prediction,
        depth=np.ascontiguousarray(depth),
        confidence=np.ascontiguousarray(confidence),
        image_to_depth=np.array([a, b, c, d]),
    )
