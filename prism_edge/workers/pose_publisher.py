"""Poses as subscribers get them: metres, REP 103 and 105 frames, ROS covariances."""

from __future__ import annotations

from typing import Any

import numpy as np

from prism_edge.bus import ros
from prism_edge.bus.session import Bus
from prism_edge.config import FramesConfig
from prism_edge.geometry.mount import base_from_camera
from prism_edge.geometry.poses import Array, adjoint, inverse, scaled, swung
from prism_edge.tracking.drift import NO_DRIFT, Walk
from prism_edge.tracking.odometry import ACCELERATION, MetricOdometry
from prism_edge.tracking.tracker import FrameResult

UNKNOWN_SPEED = 100.0  # m/s and rad/s: sigma of a velocity that nothing was measured of
OWN_SHARE = 0.125  # of a pose's variance: the rest the next one, by the same points, has too (COVARIANCE.md)


class PosePublisher:
    """Publishes `odom`, `pose` and `tf` of a tracked frame."""

    def __init__(
        self, bus: Bus, frames: FramesConfig, refinement: float = 1.0, moment_s: float = 0.0
    ) -> None:
        """``refinement`` multiplies the covariance that a frame's own points give.

        ``moment_s`` is the sigma of when a pose was so: it moves a pose along the camera's motion.
        """
        self._bus, self._frames, self._refinement, self._moment_s = bus, frames, refinement, moment_s
        self._mount = base_from_camera(frames)
        self._camera_from_base = inverse(self._mount)
        self._carry = adjoint(self._mount)

    def publish(
        self,
        stamp_ns: int,
        result: FrameResult,
        odometry: MetricOdometry,
        log_scale: float,
        scale_sigma: float,
        odom_error: Array,
        drift: Walk = NO_DRIFT,
        walk: Walk = NO_DRIFT,
        mount_of_map: Array | None = None,
    ) -> None:
        """Send the three messages of one frame; ``result`` must have a pose (map units).

        ``odometry`` has come to it. ``scale_sigma`` is that of the log scale; ``odom_error`` (3) is by what
        it puts the camera off in `odom`, metres along the axes of its start. ``drift`` is what the map may
        have drifted there since its beginning, ``walk`` what `odom` has. ``mount_of_map`` (4, 4) is
        base_from_camera of who began the map, where that may be another than ours.
        Where its place in the map is not known there is no `pose`, and `tf` ends at `odom`.
        """
        assert result.world_from_camera is not None
        metres = float(np.exp(log_scale))
        # The map begins where the base of the robot that began it was at its first keyframe.
        begun_with = self._mount if mount_of_map is None else mount_of_map
        world_from_camera = scaled(result.world_from_camera, metres)
        map_from_base = self._based(world_from_camera, begun_with)
        odom_from_base = self._based(odometry.odom_from_camera, self._mount)
        own, velocity = self._covariance(result, metres), self._carry @ odometry.twist
        aside = own + self._moment_s**2 * np.outer(velocity, velocity)
        aside += self._carry @ odometry.unseen @ self._carry.T
        # Scale multiplies the camera's path since the start; where it sits on the robot is known in metres.
        start = self._mount[:3, :3]
        walked = begun_with[:3, :3] @ world_from_camera[:3, 3]
        in_map = with_scale_error(turned(aside, map_from_base), walked, scale_sigma)
        in_odom = with_scale_error(turned(aside, odom_from_base), start @ odom_error, 1.0)
        names = self._frames
        # Two poses in a row are aside by the same moment, so that their difference knows nothing of it.
        scaled_velocity, interval_s = start @ odometry.twist[:3], odometry.interval_s
        velocity_covariance = self._velocity_covariance(own, scaled_velocity, interval_s, scale_sigma)
        if result.in_map:
            in_map = in_map + self._of_base(drift, map_from_base)
            pose = ros.pose_with_covariance(stamp_ns, names.map, map_from_base, in_map)
            self._bus.publish("pose", pose)
        in_odom = in_odom + self._of_base(walk, odom_from_base)
        moved = ros.odometry(
            stamp_ns, names.odom, names.base_link, odom_from_base, in_odom, velocity, velocity_covariance
        )
        self._bus.publish("odom", moved)
        # Most robots have the same from `odom` and `pose`.
        map_there = map_from_base if result.in_map else None
        self._bus.publish_if_heard("tf", lambda: self._tree(stamp_ns, map_there, odom_from_base))

    def _of_base(self, walk: Walk, there: Array) -> Array:
        """Covariance (6, 6) of the base at ``there``: what turns the camera on its way swings the base."""
        return swung(walk.covariance(), -(there[:3, :3] @ self._mount[:3, 3]))

    def _tree(self, stamp_ns: int, map_from_base: Array | None, odom_from_base: Array) -> Any:
        names = self._frames
        links = [
            (stamp_ns, names.odom, names.base_link, odom_from_base),
            (stamp_ns, names.base_link, names.camera, self._mount),
        ]
        if map_from_base is not None:
            links.insert(0, (stamp_ns, names.map, names.odom, map_from_base @ inverse(odom_from_base)))
        return ros.transforms(links)

    def _based(self, start_from_camera: Array, begun_with: Array) -> Array:
        """From a camera's pose relative to its start to the base's relative to the base's start.

        ``begun_with`` (4, 4) is the mount that the camera had then.
        """
        return begun_with @ start_from_camera @ self._camera_from_base

    def _covariance(self, result: FrameResult, metres: float) -> Array:
        """Covariance of the base along its own axes, of what a frame says of the camera in map units."""
        of_camera = self._refinement * result.covariance
        of_camera[:3, :3] += result.unobserved**2 * np.eye(3)  # no residual's doing: the factor is not for it
        of_camera[:3] *= metres
        of_camera[:, :3] *= metres
        return self._carry @ of_camera @ self._carry.T

    @staticmethod
    def _velocity_covariance(of_pose: Array, velocity: Array, interval_s: float, scale_sigma: float) -> Array:
        """Of the difference of two poses, which share most of their errors; and that of scale.

        Beside that it is the mean over an interval, at whose end the velocity is another.

        ``of_pose`` (6, 6) and ``velocity`` (3), the part that scale multiplies, are along the base's axes.
        """
        if interval_s <= 0.0:
            return np.eye(6) * UNKNOWN_SPEED**2
        most = UNKNOWN_SPEED**2 / max(float(np.diag(of_pose).max()), 1e-12)
        changed = min(0.5 * ACCELERATION * interval_s, UNKNOWN_SPEED) ** 2 * np.eye(6)
        of_two = of_pose * min(2.0 * OWN_SHARE / interval_s**2, most)
        return with_scale_error(of_two + changed, velocity, scale_sigma)


def turned(covariance: Array, axes_from_base: Array) -> Array:
    """A covariance (6, 6) along the base's axes, along those that the base's pose (4, 4) is in."""
    both = np.zeros((6, 6))
    both[:3, :3] = both[3:, 3:] = axes_from_base[:3, :3]
    there = both @ covariance @ both.T
    return 0.5 * (there + there.T)


def with_scale_error(covariance: Array, displacement: Array, sigma: float) -> Array:
    """Add what an error of the log scale does to a position: it moves along the camera's displacement.

    ``displacement`` (3) is the part of the position that scale multiplies: metres, the covariance's axes.
    """
    out = covariance.copy()
    out[:3, :3] += sigma**2 * np.outer(displacement, displacement)
    return out
