"""Rolling shutters: rows are read one after the other, and a camera that moves sees each from elsewhere.

Keypoints are moved to where the camera would have seen them in the middle of the readout, the time of the
frame's pose; from there on the image is as if taken at once. First by the motion that is expected, and once
the frame is placed by the motion that it had.
"""

from __future__ import annotations

import numpy as np

from prism_edge.geometry.cameras import Camera
from prism_edge.geometry.poses import Array
from prism_edge.tracking.features import Features
from prism_edge.tracking.frame_tracking import FrameTracker, TrackedFrame
from prism_edge.tracking.local_map import LocalMap

LEAST = 0.5  # of a ray's depth that is left: a wrong motion, however fast, turns no ray away


class RollingShutter:
    """A camera's readout; does nothing to what a global shutter sees."""

    def __init__(self, readout_ms: float) -> None:
        """``readout_ms``: from the first row to the last; below 0 where the last is read first."""
        self._readout_s = 1e-3 * readout_ms

    def in_the_middle(self, features: Features, camera: Camera, twist: Array, depth: float) -> Features:
        """Keypoints as seen in the middle of the readout by a camera that moves by ``twist`` a second.

        ``twist`` (6,) is the camera's, translation first, in its own frame and in the unit of ``depth``, what
        most of the scene is away: the turning is exact to first order, the shift that of a wall there.
        """
        if not (self._readout_s and twist.any()):
            return features
        rows = camera.distort_pixels(features.pixels)[:, 1]
        after_s = ((rows + 0.5) / camera.height - 0.5) * self._readout_s
        focal, centre = (camera.fx, camera.fy), (camera.cx, camera.cy)
        rays = np.ones((len(features), 3))
        rays[:, :2] = (features.pixels - centre) / focal
        rays += after_s[:, None] * (np.cross(twist[3:], rays) + twist[:3] / depth)
        pixels = rays[:, :2] / np.maximum(rays[:, 2:], LEAST) * focal + centre
        return Features.build(
            pixels, features.octaves, features.descriptors, camera.width, camera.height
        )

    def placed(
        self, world: LocalMap, frames: FrameTracker, frame: TrackedFrame, raw: Features, twist: Array,
        depth: float,
    ) -> TrackedFrame:
        """A frame placed once more, its ``raw`` keypoints moved by the motion that it turned out to have."""
        seen = self.in_the_middle(raw, frame.camera, twist, depth)
        return frame if seen is raw else frames.seen_again(world, frame, seen)
