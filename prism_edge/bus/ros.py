"""Public messages: from plain numbers to ROS 2 types, and those to CDR and back, without ROS.

Poses are 4x4 ``parent_from_child`` in metres. Covariances are 6x6 in ROS order (x y z, then rotation about
x y z); the frame each is expressed in is the one that the ROS message specifies. Quaternions have w >= 0.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from prism_edge.bus.ros_types import SCALE, type_store
from prism_edge.errors import BusError, first_line
from prism_edge.geometry.poses import Array, from_rt, quaternion_from_rotation, rotation_from_quaternion

ODOMETRY = "nav_msgs/msg/Odometry"
POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"
TRUTH = "geometry_msgs/msg/PoseStamped"
TF = "tf2_msgs/msg/TFMessage"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
IMAGE = "sensor_msgs/msg/Image"

# Levels of diagnostics, as diagnostic_msgs/msg/DiagnosticStatus numbers them.
LEVEL_OK, LEVEL_WARN, LEVEL_ERROR, LEVEL_STALE = 0, 1, 2, 3

_store = type_store()
_t = _store.types


def odometry(
    stamp_ns: int,
    frame_id: str,
    child_frame_id: str,
    pose: Array,
    covariance: Array,
    twist: Array,
    twist_covariance: Array,
) -> Any:
    """nav_msgs/Odometry: ``pose`` is frame_from_child; its covariance is in ``frame_id``.

    ``twist`` (6,) is linear (m/s), then angular velocity (rad/s), in the child frame, as is its covariance.
    """
    linear, angular = _vector(twist[:3]), _vector(twist[3:])
    return _t[ODOMETRY](
        header=_header(stamp_ns, frame_id),
        child_frame_id=child_frame_id,
        pose=_pose_with_covariance(pose, covariance),
        twist=_t["geometry_msgs/msg/TwistWithCovariance"](
            twist=_t["geometry_msgs/msg/Twist"](linear=linear, angular=angular),
            covariance=_covariance(twist_covariance),
        ),
    )


def pose_with_covariance(stamp_ns: int, frame_id: str, pose: Array, covariance: Array) -> Any:
    """geometry_msgs/PoseWithCovarianceStamped: pose and covariance in ``frame_id``."""
    return _t[POSE](header=_header(stamp_ns, frame_id), pose=_pose_with_covariance(pose, covariance))


def pose_stamped(stamp_ns: int, frame_id: str, pose: Array) -> Any:
    """geometry_msgs/PoseStamped: a pose in ``frame_id`` that is known exactly."""
    return _t[TRUTH](header=_header(stamp_ns, frame_id), pose=_pose(pose))


def transforms(links: Iterable[tuple[int, str, str, Array]]) -> Any:
    """tf2_msgs/TFMessage of (stamp_ns, parent, child, parent_from_child) each."""
    stamped = []
    for stamp_ns, parent, child, pose in links:
        transform = _t["geometry_msgs/msg/Transform"](
            translation=_vector(pose[:3, 3]), rotation=_quaternion(pose)
        )
        stamped.append(
            _t["geometry_msgs/msg/TransformStamped"](
                header=_header(stamp_ns, parent), child_frame_id=child, transform=transform
            )
        )
    return _t[TF](transforms=stamped)


def scale(
    stamp_ns: int,
    frame_id: str,
    log_scale: float,
    sigma_log: float,
    filter_sigma_log: float,
    metric: bool,
    keyframe: int = -1,
    observation: float = math.nan,
    observation_sigma: float = math.nan,
    points: int = 0,
    accepted: bool = False,
) -> Any:
    """prism_edge_msgs/Scale; the fields are explained in msg/Scale.msg."""
    return _t[SCALE](
        header=_header(stamp_ns, frame_id),
        scale=math.exp(log_scale),
        log_scale=float(log_scale),
        sigma_log=float(sigma_log),
        filter_sigma_log=float(filter_sigma_log),
        metric=bool(metric),
        keyframe=int(keyframe),
        observation=float(observation),
        observation_sigma=float(observation_sigma),
        points=int(points),
        accepted=bool(accepted),
    )


def image(stamp_ns: int, frame_id: str, values: NDArray[np.floating[Any]]) -> Any:
    """sensor_msgs/Image of one float a pixel (h, w), encoding 32FC1."""
    height, width = values.shape
    data = np.ascontiguousarray(values, dtype="<f4").view(np.uint8).ravel()
    return _t[IMAGE](
        header=_header(stamp_ns, frame_id),
        height=height,
        width=width,
        encoding="32FC1",
        is_bigendian=0,
        step=4 * width,
        data=data,
    )


def diagnostics(stamp_ns: int, statuses: Iterable[tuple[str, int, str, Mapping[str, Any]]]) -> Any:
    """diagnostic_msgs/DiagnosticArray of (name, level, message, values) each; level is one of LEVEL_*."""
    pair = _t["diagnostic_msgs/msg/KeyValue"]
    status = [
        _t["diagnostic_msgs/msg/DiagnosticStatus"](
            level=int(level),
            name=name,
            message=message,
            hardware_id="",
            values=[pair(key=str(k), value=str(v)) for k, v in values.items()],
        )
        for name, level, message, values in statuses
    ]
    return _t[DIAGNOSTICS](header=_header(stamp_ns, ""), status=status)


def stamp_ns(message: Any) -> int:
    """The stamp of a message's header in nanoseconds."""
    stamp = message.header.stamp
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def pose_matrix(pose: Any) -> Array:
    """The 4x4 matrix of a geometry_msgs/Pose or Transform."""
    position, q = (
        (pose.position, pose.orientation) if hasattr(pose, "position") else (pose.translation, pose.rotation)
    )
    rotation = rotation_from_quaternion(np.array([q.x, q.y, q.z, q.w]))
    return from_rt(rotation, np.array([position.x, position.y, position.z]))


def serialise(type_name: str, message: Any) -> bytes:
    """The message as CDR (XCDR1, this host's byte order). Raises BusError if it is no such message."""
    if getattr(message, "__msgtype__", None) != type_name:
        raise BusError(f"can't send {type(message).__name__} where {type_name} belongs")
    try:
        return bytes(_store.serialize_cdr(message, type_name))
    except Exception as error:  # the generated code raises whatever a wrong value leads to
        raise BusError(f"can't send {type_name}: {first_line(error, 160)}") from None


def deserialise(type_name: str, data: bytes) -> Any:
    """The message in CDR bytes. Raises BusError if they don't hold a ``type_name``."""
    try:
        return _store.deserialize_cdr(data, type_name)
    except Exception as error:  # the generated code raises whatever damaged bytes lead to
        raise BusError(f"malformed {type_name} message: {first_line(error, 160)}") from None


def _header(stamp: int, frame_id: str) -> Any:
    seconds, nanoseconds = divmod(int(stamp), 1_000_000_000)
    time = _t["builtin_interfaces/msg/Time"](sec=seconds, nanosec=nanoseconds)
    return _t["std_msgs/msg/Header"](stamp=time, frame_id=frame_id)


def _vector(v: Array) -> Any:
    return _t["geometry_msgs/msg/Vector3"](x=float(v[0]), y=float(v[1]), z=float(v[2]))


def _quaternion(pose: Array) -> Any:
    x, y, z, w = quaternion_from_rotation(pose[:3, :3]).tolist()
    return _t["geometry_msgs/msg/Quaternion"](x=x, y=y, z=z, w=w)


def _covariance(covariance: Array) -> Array:
    return np.ascontiguousarray(covariance, dtype=np.float64).reshape(36)


def _pose(pose: Array) -> Any:
    x, y, z = pose[:3, 3].tolist()
    position = _t["geometry_msgs/msg/Point"](x=x, y=y, z=z)
    return _t["geometry_msgs/msg/Pose"](position=position, orientation=_quaternion(pose))


def _pose_with_covariance(pose: Array, covariance: Array) -> Any:
    return _t["geometry_msgs/msg/PoseWithCovariance"](pose=_pose(pose), covariance=_covariance(covariance))
