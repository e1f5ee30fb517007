"""Metric odometry: the camera's motion summed up, so that no correction of the map makes it jump."""

from __future__ import annotations

from collections import deque

import numpy as np

from prism_edge.geometry.poses import Array, inverse, normalised, scaled, se3_log

# A step that took longer, and more than twice as long as the one before, tells how far the camera went, not
# how fast it is: images were missing.
GAP_S = 0.5
STILL_S = 0.1  # for so long, or for two intervals, a velocity holds through exact copies
# No longer: a trembling twist would carry a camera off that stands, which a video of nothing new shows, too.
ELSEWHERE_S = 1.0
# Sigma of how a velocity changes within the interval that it was measured over, m/s^2 and rad/s^2: a hand's
# goes by 0.1 m/s and 0.1 rad/s however long that is, from 0.1 s on.
ACCELERATION = 1.0


class MetricOdometry:
    """Integrates motion between consecutive frames, measured in one state of the map and turned to metres."""

    def __init__(self) -> None:
        self.odom_from_camera = np.eye(4)
        self.twist = np.zeros(6)  # m/s and rad/s in the camera frame
        self.interval_s = 0.0  # over which it was measured; 0: nothing is known of it
        # Of where the camera has gone since the image that a copy repeats (6, 6): m, rad, in its own axes.
        self.unseen = np.zeros((6, 6))
        self._seen = (0, np.zeros(6), 0.0)  # of the last image that was none: stamp (ns), twist, interval (s)
        self._stamp_ns: int | None = None
        self._pace_s = 0.0  # the last step's time
        self._lately: deque[tuple[int, Array]] = deque()  # stamps and poses, each step's a known time

    def advance(
        self, before: Array | None, after: Array, log_scale: float, stamp_ns: int, longer_s: float = 0.0
    ) -> None:
        """The camera has gone on to a frame at ``after`` (world_from_camera, map units).

        ``before`` is where the *present* map has the last tracked frame: a correction moves both alike. Exact
        copies of a frame are none: the step after them takes their time too. ``longer_s``: where images come
        together that were not taken so, the velocity is that of the last steps that took longer than this.
        """
        self.twist, self.interval_s, known = np.zeros(6), 0.0, False
        if before is not None:
            step = scaled(inverse(before) @ after, float(np.exp(log_scale)))
            self.odom_from_camera = normalised(self.odom_from_camera @ step)
            elapsed = (stamp_ns - (self._stamp_ns or 0)) * 1e-9
            if self._stamp_ns is not None and elapsed > 0:
                known = not self._pace_s or elapsed <= max(GAP_S, 2.0 * self._pace_s)
                self._pace_s = elapsed
        if not known:
            self._lately.clear()
        self._lately.append((stamp_ns, self.odom_from_camera))
        if known:
            while len(self._lately) > 2 and (stamp_ns - self._lately[1][0]) * 1e-9 > longer_s:
                self._lately.popleft()
            since_ns, there = self._lately[0]
            self.interval_s = (stamp_ns - since_ns) * 1e-9
            self.twist = se3_log(inverse(there) @ self.odom_from_camera) / self.interval_s
        self._stamp_ns, self._seen = stamp_ns, (stamp_ns, self.twist, self.interval_s)
        self.unseen = np.zeros((6, 6))

    def repeat(self, stamp_ns: int) -> None:
        """An exact copy of the last frame: after some of them the velocity is not known any more.

        A camera that stands and one that hangs show the same: one that moved before may be elsewhere by now.
        """
        seen_ns, twist, interval_s = self._seen
        self.unseen = unseen_motion(twist, interval_s, min((stamp_ns - seen_ns) * 1e-9, ELSEWHERE_S))
        last_ns = stamp_ns if self._stamp_ns is None else self._stamp_ns
        if (stamp_ns - last_ns) * 1e-9 > max(2.0 * self.interval_s, STILL_S):
            self.lose()

    def lose(self) -> None:
        """How fast the camera is isn't known, and the next step says nothing of it: it took any time."""
        self.twist, self.interval_s, self._stamp_ns = np.zeros(6), 0.0, None
        self._lately.clear()


def unseen_motion(twist: Array, interval_s: float, elapsed_s: float) -> Array:
    """Covariance (6, 6; m, rad) of where a camera has gone that was last seen ``elapsed_s`` ago.

    ``twist`` (6; m/s, rad/s), measured over ``interval_s``, says where to; on the way it changes, at most by
    itself: of a camera that stood nothing says that it began to move. Axes are the camera's.
    """
    changed = 0.5 * ACCELERATION * (interval_s + elapsed_s)  # the twist is that of the interval's middle
    changes = [min(changed, float(np.linalg.norm(part))) for part in (twist[:3], twist[3:])]
    return elapsed_s**2 * (np.outer(twist, twist) + np.diag(np.repeat(changes, 3) ** 2))
