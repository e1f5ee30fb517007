"""Where the camera will be: it goes on as it went from the last frame but one to the last."""

from __future__ import annotations

import numpy as np

from prism_edge.geometry.poses import Array, inverse, se3_exp, se3_log

LONGEST_S = 0.6  # between two frames that still say how fast the camera is


class ConstantVelocity:
    """A twist of the camera, in its own frame, per second; zero where nothing is known of it."""

    def __init__(self) -> None:
        self.stamp_ns = 0  # of the last frame
        self.twist = np.zeros(6)

    def stop(self) -> None:
        """What was known of the motion is not to be trusted."""
        self.twist = np.zeros(6)

    def predict(self, world_from_camera: Array, stamp_ns: int) -> Array:
        """Pose (4, 4) at a time, of a camera that was at a pose when the last frame was taken."""
        moved: Array = world_from_camera @ se3_exp(self.twist * ((stamp_ns - self.stamp_ns) * 1e-9))
        return moved

    def follow(self, before: Array | None, after: Array, stamp_ns: int) -> None:
        """A frame is placed; ``before`` is where the same map has the one before it."""
        self.twist = self.since(before, after, stamp_ns)
        self.stamp_ns = stamp_ns

    def since(self, before: Array | None, after: Array, stamp_ns: int) -> Array:
        """The twist (6,) from the last frame to one at ``after``; zero where the two tell nothing of it."""
        elapsed_s = (stamp_ns - self.stamp_ns) * 1e-9
        if before is None or not 0 < elapsed_s < LONGEST_S:
            return np.zeros(6)
        return se3_log(inverse(before) @ after) / elapsed_s
