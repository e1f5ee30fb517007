"""The ROS 2 types that go over the bus, and those they consist of: a store of just these.

rosbags has all of a ROS 2 release in one module, which takes longer to load than NumPy does.
A test compares these, field by field, with the release's (ROS 2 Jazzy; other releases have the same).
"""

from __future__ import annotations

from pathlib import Path

from rosbags.typesys import get_types_from_msg
from rosbags.typesys.store import Typestore

SCALE = "prism_edge_msgs/msg/Scale"
SCALE_DEFINITION = Path(__file__).parent / "msg" / "Scale.msg"

# Type: its fields, as a .msg file would have them, with a semicolon for the line's end.
STANDARD = {
    "builtin_interfaces/msg/Time": "int32 sec; uint32 nanosec",
    "std_msgs/msg/Header": "builtin_interfaces/Time stamp; string frame_id",
    "geometry_msgs/msg/Point": "float64 x; float64 y; float64 z",
    "geometry_msgs/msg/Vector3": "float64 x; float64 y; float64 z",
    "geometry_msgs/msg/Quaternion": "float64 x; float64 y; float64 z; float64 w",
    "geometry_msgs/msg/Pose": "Point position; Quaternion orientation",
    "geometry_msgs/msg/PoseStamped": "std_msgs/Header header; Pose pose",
    "geometry_msgs/msg/PoseWithCovariance": "Pose pose; float64[36] covariance",
    "geometry_msgs/msg/PoseWithCovarianceStamped": "std_msgs/Header header; PoseWithCovariance pose",
    "geometry_msgs/msg/Twist": "Vector3 linear; Vector3 angular",
    "geometry_msgs/msg/TwistWithCovariance": "Twist twist; float64[36] covariance",
    "geometry_msgs/msg/Transform": "Vector3 translation; Quaternion rotation",
    "geometry_msgs/msg/TransformStamped": "std_msgs/Header header; string child_frame_id; "
    "Transform transform",
    "tf2_msgs/msg/TFMessage": "geometry_msgs/TransformStamped[] transforms",
    "nav_msgs/msg/Odometry": "std_msgs/Header header; string child_frame_id; "
    "geometry_msgs/PoseWithCovariance pose; geometry_msgs/TwistWithCovariance twist",
    "diagnostic_msgs/msg/KeyValue": "string key; string value",
    "diagnostic_msgs/msg/DiagnosticStatus": "byte level; string name; string message; string hardware_id; "
    "KeyValue[] values",
    "diagnostic_msgs/msg/DiagnosticArray": "std_msgs/Header header; DiagnosticStatus[] status",
    "sensor_msgs/msg/Image": "std_msgs/Header header; uint32 height; uint32 width; string encoding; "
    "uint8 is_bigendian; uint32 step; uint8[] data",
}


def type_store() -> Typestore:
    """The types of :data:`STANDARD`, and our own."""
    types = get_types_from_msg(SCALE_DEFINITION.read_text(encoding="utf-8"), SCALE)
    for name, fields in STANDARD.items():
        types |= get_types_from_msg(fields.replace("; ", "\n"), name)
    store = Typestore()
    store.register(types)
    return store
