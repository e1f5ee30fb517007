"""ROS 2 messages: values, conventions, bytes."""

from __future__ import annotations

import math
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore

from prism_edge.bus import ros
from prism_edge.bus.ros_types import SCALE_DEFINITION
from prism_edge.errors import BusError
from prism_edge.geometry.poses import from_rt, se3_exp, so3_exp

STAMP = 1_700_000_000_123_456_789
POSE = se3_exp(np.array([1.0, 2.0, 3.0, 0.1, -0.2, 0.3]))
COVARIANCE = np.arange(36.0).reshape(6, 6)
TWIST = np.arange(1.0, 7.0)

EXAMPLES = {
    ros.ODOMETRY: ros.odometry(STAMP, "odom", "base_link", POSE, COVARIANCE, TWIST, COVARIANCE + 100),
    ros.POSE: ros.pose_with_covariance(STAMP, "map", POSE, COVARIANCE),
    ros.TRUTH: ros.pose_stamped(STAMP, "map", POSE),
    ros.IMAGE: ros.image(STAMP, "camera", np.arange(6.0).reshape(2, 3)),
    ros.TF: ros.transforms([(STAMP, "map", "odom", POSE), (STAMP + 1, "odom", "base_link", np.eye(4))]),
    ros.SCALE: ros.scale(STAMP, "map", 0.1, 0.2, 0.15, True, 7, 0.12, 0.3, 42, True),
    ros.DIAGNOSTICS: ros.diagnostics(STAMP, [("tracking", ros.LEVEL_WARN, "lost", {"fps": 29.5})]),
}

# what any ROS 2 node would read them with
FOREIGN = get_typestore(Stores.ROS2_HUMBLE)


def there_and_back(type_name, message):
    return ros.deserialise(type_name, ros.serialise(type_name, message))


@pytest.mark.parametrize("type_name", EXAMPLES)
def test_round_trip(type_name):
    message = EXAMPLES[type_name]
    data = ros.serialise(type_name, message)
    assert ros.serialise(type_name, ros.deserialise(type_name, data)) == data


@pytest.mark.parametrize("type_name", EXAMPLES)
def test_bytes_begin_with_the_cdr_header_of_little_endian(type_name):
    assert ros.serialise(type_name, EXAMPLES[type_name])[:4] == b"\0\1\0\0"


def test_the_layout_of_a_pose_byte_by_byte():
    data = ros.serialise(ros.POSE, ros.pose_with_covariance(STAMP, "map", POSE, COVARIANCE))
    body = data[4:]
    assert struct.unpack_from("<iI", body, 0) == (1_700_000_000, 123_456_789)
    assert struct.unpack_from("<I4s", body, 8) == (4, b"map\0")
    numbers = struct.unpack_from("<43d", body, 16)
    assert numbers[:3] == tuple(POSE[:3, 3])
    assert numbers[7:] == tuple(range(36))
    assert len(body) == 16 + 43 * 8


def test_another_distribution_of_ros_reads_the_same():
    message = FOREIGN.deserialize_cdr(ros.serialise(ros.ODOMETRY, EXAMPLES[ros.ODOMETRY]), ros.ODOMETRY)
    assert message.header.frame_id == "odom"
    assert message.child_frame_id == "base_link"
    assert message.twist.twist.linear.x == 1.0
    assert message.twist.twist.angular.z == 6.0
    assert np.array_equal(message.twist.covariance, COVARIANCE.ravel() + 100)


def test_an_image_s_rows_are_as_long_as_it_says():
    message = FOREIGN.deserialize_cdr(ros.serialise(ros.IMAGE, EXAMPLES[ros.IMAGE]), ros.IMAGE)
    assert (message.height, message.width, message.step, message.encoding) == (2, 3, 12, "32FC1")
    rows = message.data.reshape(message.height, message.step)
    assert rows.view("<f4").tolist() == [[0.0, 1.0, 2.0], [3.0, 4.0, 5.0]]


@pytest.mark.parametrize(
    ("rotation_vector", "xyzw"),
    [
        ((0, 0, 0), (0, 0, 0, 1)),
        ((0, 0, math.pi / 2), (0, 0, math.sqrt(0.5), math.sqrt(0.5))),  # a turn to the left (REP 103)
        ((math.pi / 2, 0, 0), (math.sqrt(0.5), 0, 0, math.sqrt(0.5))),
        ((0, 3.0, 0), (0, math.sin(1.5), 0, math.cos(1.5))),
        ((0, 0, -3.0), (0, 0, -math.sin(1.5), math.cos(1.5))),
        ((0, 0, 4.0), (0, 0, -math.sin(2.0), -math.cos(2.0))),  # the other sign has w < 0
    ],
)
def test_quaternions(rotation_vector, xyzw):
    pose = from_rt(so3_exp(np.array(rotation_vector, dtype=float)), np.zeros(3))
    q = ros.pose_with_covariance(0, "map", pose, np.eye(6)).pose.pose.orientation
    assert np.allclose([q.x, q.y, q.z, q.w], xyzw, atol=1e-12)


@settings(max_examples=50, deadline=None)
@given(st.lists(st.floats(-3, 3), min_size=6, max_size=6))
def test_a_pose_comes_back_as_it_went(twist):
    pose = se3_exp(np.array(twist))
    odometry = ros.odometry(0, "odom", "base_link", pose, np.eye(6), np.zeros(6), np.eye(6))
    assert np.allclose(ros.pose_matrix(there_and_back(ros.ODOMETRY, odometry).pose.pose), pose, atol=1e-9)
    link = there_and_back(ros.TF, ros.transforms([(0, "map", "odom", pose)])).transforms[0]
    assert np.allclose(ros.pose_matrix(link.transform), pose, atol=1e-9)


def test_rows_of_the_covariance_follow_each_other():
    covariance = np.diag([1.0, 2, 3, 4, 5, 6])
    covariance[0, 5] = 7.0  # x against rotation about z
    message = there_and_back(ros.POSE, ros.pose_with_covariance(0, "map", POSE, covariance.T.copy().T))
    assert message.pose.covariance[5] == 7.0
    assert message.pose.covariance[30] == 0.0
    assert list(message.pose.covariance[::7]) == [1, 2, 3, 4, 5, 6]


@settings(max_examples=100, deadline=None)
@given(st.integers(0, 2**31 * 10**9 - 1))
def test_stamps_are_split_exactly(stamp_ns):
    message = there_and_back(ros.DIAGNOSTICS, ros.diagnostics(stamp_ns, []))
    assert 0 <= message.header.stamp.nanosec < 10**9
    assert ros.stamp_ns(message) == stamp_ns


def test_transforms_name_parent_and_child():
    first, second = there_and_back(ros.TF, EXAMPLES[ros.TF]).transforms
    assert (first.header.frame_id, first.child_frame_id) == ("map", "odom")
    assert (second.header.frame_id, second.child_frame_id) == ("odom", "base_link")
    assert second.header.stamp.nanosec == first.header.stamp.nanosec + 1


def test_scale_has_the_fields_of_its_definition_file():
    message = there_and_back(ros.SCALE, EXAMPLES[ros.SCALE])
    lines = SCALE_DEFINITION.read_text().splitlines()
    defined = [line.split()[1] for line in lines if line and not line.startswith("#")]
    assert [name for name in vars(message) if not name.startswith("_")] == defined
    assert message.scale == pytest.approx(math.exp(0.1))
    assert (message.log_scale, message.sigma_log, message.filter_sigma_log) == (0.1, 0.2, 0.15)
    assert (message.metric, message.keyframe, message.points, message.accepted) == (True, 7, 42, True)


def test_a_scale_without_observation_says_so():
    message = there_and_back(ros.SCALE, ros.scale(STAMP, "map", 0.0, 0.3, 0.3, metric=False))
    assert math.isnan(message.observation)
    assert (message.metric, message.accepted, message.keyframe) == (False, False, -1)


def test_every_field_of_the_scale_is_explained():
    for line in SCALE_DEFINITION.read_text().splitlines():
        assert not line or "#" in line


def test_diagnostics_carry_level_and_values_as_text():
    (status,) = there_and_back(ros.DIAGNOSTICS, EXAMPLES[ros.DIAGNOSTICS]).status
    assert (status.name, status.level, status.message) == ("tracking", 1, "lost")
    assert [(pair.key, pair.value) for pair in status.values] == [("fps", "29.5")]


@pytest.mark.parametrize(
    ("type_name", "message"),
    [
        (ros.POSE, EXAMPLES[ros.ODOMETRY]),
        (ros.POSE, "text"),
        (ros.POSE, None),
        (ros.DIAGNOSTICS, ros.diagnostics(2**63, [])),  # seconds beyond the 32 bits of ROS
        (ros.DIAGNOSTICS, ros.diagnostics(0, [("n", 300, "", {})])),
        (ros.DIAGNOSTICS, ros.diagnostics(0, [("\udc80", 0, "", {})])),
        (ros.SCALE, ros.scale(0, "map", 0, 0, 0, True, points=-1)),
    ],
)
def test_what_does_not_fit_is_a_bus_error(type_name, message):
    with pytest.raises(BusError, match="can't send") as caught:
        ros.serialise(type_name, message)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("type_name", EXAMPLES)
def test_damaged_bytes_raise_nothing_else_than_a_bus_error(type_name):
    good = ros.serialise(type_name, EXAMPLES[type_name])
    cut = (b"", b"\0", b"\0\1\0\0", good[:-9], good[: len(good) // 2])
    for bad in (*cut, good + b"\0" * 8, b"\7" + good[1:]):
        with pytest.raises(BusError, match="malformed"):
            ros.deserialise(type_name, bad)
    random = np.random.default_rng(0)
    for _ in range(200):
        damaged = bytearray(good)
        for position in random.integers(4, len(good), 3):
            damaged[position] = random.integers(256)
        try:
            ros.deserialise(type_name, bytes(damaged))
        except BusError:
            continue
