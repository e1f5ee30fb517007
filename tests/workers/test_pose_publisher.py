"""What subscribers get: frames, metres and covariances."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from prism_edge.bus import ros
from prism_edge.config import FramesConfig
from prism_edge.geometry.poses import from_rt, inverse, rotation_from_quaternion, se3_exp, so3_exp, so3_log
from prism_edge.messages import OK
from prism_edge.topics import TOPICS
from prism_edge.tracking.drift import Walk
from prism_edge.tracking.odometry import MetricOdometry
from prism_edge.tracking.tracker import FrameResult
from prism_edge.workers.pose_publisher import (
    ACCELERATION,
    OWN_SHARE,
    UNKNOWN_SPEED,
    PosePublisher,
    with_scale_error,
)
from tests.tracking.cloud import pose_at

STAMP = 12_345_678_901
MOUNTED = FramesConfig(base_from_camera_xyz=(0.3, -0.1, 0.5), base_from_camera_xyzw=(-0.4, 0.5, -0.55, 0.53))
COVARIANCE = np.array(
    [
        [4.0, 0.3, -0.2, 0.1, 0.5, 0.0],
        [0.3, 3.0, 0.4, -0.6, 0.0, 0.1],
        [-0.2, 0.4, 9.0, 0.0, 0.2, 0.1],
        [0.1, -0.6, 0.0, 1.5, 0.1, 0.0],
        [0.5, 0.0, 0.2, 0.1, 1.0, -0.2],
        [0.0, 0.1, 0.1, 0.0, -0.2, 0.5],
    ]
) * 1e-6


def mount(frames: FramesConfig) -> np.ndarray:
    rotation = rotation_from_quaternion(np.array(frames.base_from_camera_xyzw))
    return from_rt(rotation, np.array(frames.base_from_camera_xyz))


def odometry(odom_from_camera=None, twist=None, interval_s=0.1, unseen=None):
    """What has come to a place, by default without having moved."""
    there = MetricOdometry()
    there.odom_from_camera = np.eye(4) if odom_from_camera is None else odom_from_camera
    there.twist, there.interval_s = np.zeros(6) if twist is None else twist, interval_s
    there.unseen = np.zeros((6, 6)) if unseen is None else unseen
    return there


def publish(
    pose,
    frames=None,
    odom=None,
    covariance=COVARIANCE,
    twist=None,
    log_scale=0.0,
    sigma=0.0,
    interval_s=0.1,
    moment_s=0.0,
    in_map=True,
    unseen=None,
):
    """The messages of one frame, by topic; through CDR, as they arrive."""
    sent = {}
    bus = SimpleNamespace(
        publish=lambda topic, message: sent.update({topic: message}),
        publish_if_heard=lambda topic, make: sent.update({topic: make()}),
    )
    result = FrameResult(OK, pose, covariance, 0, np.eye(4), 100, in_map)
    odom = pose if odom is None else odom
    publisher = PosePublisher(bus, frames or FramesConfig(), moment_s=moment_s)
    error = sigma * odom[:3, 3]
    moved = odometry(odom, twist, interval_s, unseen)
    publisher.publish(STAMP, result, moved, log_scale, sigma, error)
    return {
        topic: ros.deserialise(TOPICS[topic].type, ros.serialise(TOPICS[topic].type, message))
        for topic, message in sent.items()
    }


def position(message) -> np.ndarray:
    return ros.pose_matrix(message.pose.pose)[:3, 3]


def matrix(message) -> np.ndarray:
    return np.asarray(message.pose.covariance).reshape(6, 6)


@pytest.mark.parametrize(
    ("camera", "base"),
    [((0, 0, 1), (1, 0, 0)), ((1, 0, 0), (0, -1, 0)), ((0, 1, 0), (0, 0, -1))],
)
def test_axes_are_those_of_rep_103(camera, base):
    """The camera's z is forward, its x right and its y down; the robot's x forward, y left, z up."""
    sent = publish(pose_at(*(2.0 * np.array(camera))))
    for topic in ("pose", "odom"):
        assert position(sent[topic]) == pytest.approx(2.0 * np.array(base), abs=1e-9)


def test_a_turn_to_the_right_is_negative_about_z():
    sent = publish(pose_at(0, 0, 0, 0, 0.3, 0))
    assert so3_log(ros.pose_matrix(sent["pose"].pose.pose)[:3, :3]) == pytest.approx([0, 0, -0.3], abs=1e-9)


def test_names_and_stamps():
    names = FramesConfig(map="m", odom="o", base_link="b", camera="c")
    sent = publish(pose_at(0.1), names)
    assert set(sent) == {"pose", "odom", "tf"}
    assert sent["pose"].header.frame_id == "m"
    assert (sent["odom"].header.frame_id, sent["odom"].child_frame_id) == ("o", "b")
    links = [(t.header.frame_id, t.child_frame_id) for t in sent["tf"].transforms]
    assert links == [("m", "o"), ("o", "b"), ("b", "c")]
    for message in (sent["pose"], sent["odom"], *sent["tf"].transforms):
        assert ros.stamp_ns(message) == STAMP


def test_where_its_place_in_the_map_is_not_known_the_tree_ends_at_odom():
    sent = publish(pose_at(0.1), in_map=False)
    assert set(sent) == {"odom", "tf"}
    links = [(t.header.frame_id, t.child_frame_id) for t in sent["tf"].transforms]
    assert links == [("odom", "base_link"), ("base_link", FramesConfig().camera)]


def test_covariances_are_the_same_on_either_side_of_the_diagonal_to_the_last_digit():
    """Who takes their root asks for that."""
    for seed in range(5):
        turn = se3_exp(np.random.default_rng(seed).normal(size=6))
        sent = publish(turn, MOUNTED, odom=turn @ turn, log_scale=0.3, sigma=0.1)
        for topic in ("pose", "odom"):
            assert np.array_equal(matrix(sent[topic]), matrix(sent[topic]).T)


def test_over_next_to_no_time_a_velocity_is_as_unknown_as_one_can_be_and_no_more():
    sent = publish(pose_at(0.1), interval_s=1e-9)
    variances = np.asarray(sent["odom"].twist.covariance).reshape(6, 6).diagonal()
    assert variances.max() == pytest.approx(UNKNOWN_SPEED**2)


def test_the_map_is_in_units_and_the_pose_in_metres():
    sent = publish(pose_at(0, 0, 1.5), odom=pose_at(0, 0, 7.0), log_scale=np.log(2.0))
    assert position(sent["pose"]) == pytest.approx([3.0, 0, 0])
    assert position(sent["odom"]) == pytest.approx([7.0, 0, 0]), "odometry comes in metres already"


def test_a_mounted_camera_s_robot_starts_at_the_origin():
    sent = publish(np.eye(4), MOUNTED)
    for topic in ("pose", "odom"):
        assert ros.pose_matrix(sent[topic].pose.pose) == pytest.approx(np.eye(4), abs=1e-9)


def test_the_tree_of_frames_joins_pose_and_odometry():
    pose, odom = pose_at(0.4, 0.1, 2.0, 0.1, 0.5, 0.0), pose_at(1.0, 0.0, 1.5, 0.0, 0.4, 0.1)
    sent = publish(pose, MOUNTED, odom=odom)
    map_odom, odom_base, base_camera = (ros.pose_matrix(t.transform) for t in sent["tf"].transforms)
    assert map_odom @ odom_base == pytest.approx(ros.pose_matrix(sent["pose"].pose.pose), abs=1e-9)
    assert odom_base == pytest.approx(ros.pose_matrix(sent["odom"].pose.pose), abs=1e-9)
    assert base_camera == pytest.approx(mount(MOUNTED))
    # The camera in the map's frame: its own world, seen from where the robot's base was at the start.
    assert map_odom @ odom_base @ base_camera == pytest.approx(mount(MOUNTED) @ pose, abs=1e-9)


@pytest.mark.parametrize("frames", [FramesConfig(), MOUNTED])
@pytest.mark.parametrize(("topic", "log_scale"), [("pose", 0.0), ("pose", np.log(1.7)), ("odom", 0.0)])
def test_covariance_is_that_of_many_disturbed_cameras(frames, topic, log_scale):
    """The camera errs by a small twist in its own frame; ROS wants the base's error along fixed axes."""
    pose, elsewhere = pose_at(0.5, -0.2, 1.5, 0.2, 0.6, -0.1), pose_at(-1.0, 0.3, 0.4, 1.2, -0.5, 0.8)
    # As after a restart or a loop: `map` and `odom` are turned against each other.
    there = {"pose": (pose, elsewhere), "odom": (elsewhere, pose)}[topic]
    stated = matrix(publish(there[0], frames, odom=there[1], log_scale=log_scale)[topic])
    rng, metres, base = np.random.default_rng(0), np.exp(log_scale), mount(frames)

    def base_pose(camera):
        metric = camera.copy()
        metric[:3, 3] *= metres
        return base @ metric @ inverse(base)

    true = base_pose(pose)
    errors = []
    for twist in rng.multivariate_normal(np.zeros(6), COVARIANCE, 4000):
        moved = base_pose(pose @ se3_exp(twist))
        errors.append(np.r_[moved[:3, 3] - true[:3, 3], so3_log(moved[:3, :3] @ true[:3, :3].T)])
    sampled = np.cov(np.array(errors).T)
    size = np.sqrt(np.outer(np.diag(stated), np.diag(stated)))
    assert np.abs((sampled - stated) / size).max() < 0.08


def test_an_error_of_scale_moves_along_the_line_to_the_origin():
    place = np.array([3.0, -4.0, 12.0])
    added = with_scale_error(COVARIANCE, place, 0.1) - COVARIANCE
    values, vectors = np.linalg.eigh(added[:3, :3])
    assert values == pytest.approx([0, 0, (0.1 * 13.0) ** 2], abs=1e-9)
    assert abs(vectors[:, 2] @ place) == pytest.approx(13.0)
    assert not added[3:].any()
    assert not added[:, 3:].any()


def test_scale_error_of_pose_and_odometry_grows_with_their_own_distance():
    pose, odom = pose_at(0, 0, 2.0), pose_at(0, 0, 5.0)
    sure = publish(pose, odom=odom)
    unsure = publish(pose, odom=odom, sigma=0.1)
    for topic, distance in (("pose", 2.0), ("odom", 5.0)):
        added = matrix(unsure[topic]) - matrix(sure[topic])
        expected = np.zeros((6, 6))
        expected[0, 0] = (0.1 * distance) ** 2
        assert added == pytest.approx(expected, abs=1e-12)


def test_scale_error_of_a_mounted_camera_s_robot_is_what_scale_does_to_it():
    """Against the numerical derivative by log scale: the lever from robot to camera has none of it."""
    pose, sigma, step = pose_at(0.3, -0.2, 0.6, 0.4, 1.5, -0.3), 0.1, 1e-6
    base, odom = mount(MOUNTED), pose_at(0.1, 0.4, 0.5, 0.3, 1.4, -0.2)

    def place(camera, log_scale):
        metric = camera.copy()
        metric[:3, 3] *= np.exp(log_scale)
        return (base @ metric @ inverse(base))[:3, 3]

    sure, unsure = (publish(pose, MOUNTED, odom=odom, log_scale=0.5, sigma=s) for s in (0.0, sigma))
    for topic, camera, at in (("pose", pose, 0.5), ("odom", odom, 0.0)):
        slope = (place(camera, at + step) - place(camera, at - step)) / (2 * step)
        added = matrix(unsure[topic]) - matrix(sure[topic])
        assert added[:3, :3] == pytest.approx(sigma**2 * np.outer(slope, slope), abs=1e-9)
        assert np.abs(added[3:]).max() < 1e-15
    turned_on_the_spot = publish(pose_at(0, 0, 0, 0.4, 1.5, -0.3), MOUNTED, sigma=5.0)["pose"]
    assert np.linalg.norm(position(turned_on_the_spot)) > 0.3
    assert np.abs(matrix(turned_on_the_spot)).max() < 1e-4, "a robot that only turned has no error of scale"


def test_the_argument_is_left_as_it_was():
    before = COVARIANCE.copy()
    with_scale_error(COVARIANCE, np.ones(3), 1.0)
    assert np.array_equal(COVARIANCE, before)


@pytest.mark.parametrize("frames", [FramesConfig(), MOUNTED])
def test_twist_is_the_base_s_own_motion(frames):
    pose, twist = pose_at(0.5, 0.2, 1.0, 0.3, -0.2, 0.1), np.array([0.4, -0.2, 1.0, 0.3, -0.5, 0.2])
    message = publish(pose, frames, twist=twist)["odom"].twist.twist
    got = np.array([*(getattr(v, a) for v in (message.linear, message.angular) for a in "xyz")])
    base, dt = mount(frames), 1e-6
    before, after = (base @ p @ inverse(base) for p in (pose, pose @ se3_exp(dt * twist)))
    step = inverse(before) @ after
    assert got == pytest.approx(np.r_[step[:3, 3], so3_log(step[:3, :3])] / dt, rel=1e-4, abs=1e-5)


def test_the_twist_s_covariance_is_along_the_base_s_axes():
    """However the robot stands in the map, what it knows of its own motion is the same."""
    straight, turned = (
        np.asarray(publish(pose, MOUNTED)["odom"].twist.covariance)
        for pose in (np.eye(4), pose_at(1.0, 2.0, 3.0, 0.2, 1.0, -0.4))
    )
    assert turned == pytest.approx(straight, rel=1e-6, abs=1e-12)
    assert straight.reshape(6, 6)[0, 0] > 0


@pytest.mark.parametrize("interval_s", [0.02, 0.1])
def test_the_twist_s_covariance_is_that_of_two_disturbed_cameras_and_of_scale(interval_s):
    pose, rng, sigma = pose_at(0.5, -0.2, 1.5, 0.2, 0.6, -0.1), np.random.default_rng(0), 0.1
    twist = np.array([0.4, -0.2, 1.0, 0.3, -0.5, 0.2])
    odom = publish(pose, MOUNTED, twist=twist, interval_s=interval_s, sigma=sigma)["odom"]
    stated = np.asarray(odom.twist.covariance).reshape(6, 6)
    base, after, found = mount(MOUNTED), pose @ se3_exp(interval_s * twist), []
    for first, second in rng.multivariate_normal(np.zeros(6), OWN_SHARE * COVARIANCE, (4000, 2)):
        step = inverse(pose @ se3_exp(first)) @ after @ se3_exp(second)
        step[:3, 3] *= np.exp(rng.normal(0.0, sigma))
        moved = base @ step @ inverse(base)
        changed = rng.normal(0.0, 0.5 * ACCELERATION * interval_s, 6)  # from the mean to the interval's end
        found.append(np.r_[moved[:3, 3], so3_log(moved[:3, :3])] / interval_s + changed)
    sampled = np.cov(np.array(found).T)
    size = np.sqrt(np.outer(np.diag(stated), np.diag(stated)))
    assert np.abs((sampled - stated) / size).max() < 0.12


@pytest.mark.parametrize("log_scale", [0.0, 0.7])
def test_a_pose_may_be_that_of_a_moment_aside(log_scale):
    """What a shift in time does to base and orientation, by differences; a velocity is as sure as before."""
    pose, odom = pose_at(1.0, -0.4, 2.0, 0.3, -0.2, 0.5), pose_at(0.7, 0.1, 1.0, -0.1, 0.4, 0.2)
    twist, moment_s = np.array([0.3, -0.1, 0.8, 0.2, 0.5, -0.4]), 0.02
    plain, aside = (
        publish(pose, MOUNTED, odom, twist=twist, log_scale=log_scale, moment_s=s) for s in (0.0, moment_s)
    )
    in_metres = pose.copy()
    in_metres[:3, 3] *= np.exp(log_scale)
    for topic, camera in (("pose", in_metres), ("odom", odom)):
        before, after = (
            mount(MOUNTED) @ camera @ se3_exp(twist * t) @ inverse(mount(MOUNTED)) for t in (-1e-4, 1e-4)
        )
        turned = so3_log(after[:3, :3] @ before[:3, :3].T)
        rate = np.concatenate([after[:3, 3] - before[:3, 3], turned]) / 2e-4
        added = matrix(aside[topic]) - matrix(plain[topic])
        assert added == pytest.approx(moment_s**2 * np.outer(rate, rate), rel=1e-4, abs=1e-10)
    velocities = [np.asarray(sent["odom"].twist.covariance) for sent in (plain, aside)]
    assert velocities[0] == pytest.approx(velocities[1])


@pytest.mark.parametrize("log_scale", [0.0, 0.7])
def test_a_way_that_nobody_saw_is_that_of_the_base(log_scale):
    """What the camera's way, in metres, does to base and orientation, by trials; a velocity is as sure."""
    pose, unseen, found = pose_at(1.0, -0.4, 2.0, 0.3, -0.2, 0.5), 1e4 * COVARIANCE, []
    plain, aside = (publish(pose, MOUNTED, log_scale=log_scale, unseen=u) for u in (None, unseen))
    here = mount(MOUNTED) @ pose @ inverse(mount(MOUNTED))
    for gone in np.random.default_rng(0).multivariate_normal(np.zeros(6), 1e-4 * unseen, 4000):
        there = mount(MOUNTED) @ pose @ se3_exp(gone) @ inverse(mount(MOUNTED))
        turned = so3_log(there[:3, :3] @ here[:3, :3].T)
        found.append(100.0 * np.concatenate([there[:3, 3] - here[:3, 3], turned]))
    for topic in ("pose", "odom"):
        added = matrix(aside[topic]) - matrix(plain[topic])
        size = np.sqrt(np.outer(np.diag(added), np.diag(added)))
        assert np.abs((np.cov(np.array(found).T) - added) / size).max() < 0.08
    velocities = [np.asarray(sent["odom"].twist.covariance) for sent in (plain, aside)]
    assert velocities[0] == pytest.approx(velocities[1])


def test_a_velocity_that_was_not_measured_says_so():
    for message in (publish(np.eye(4), interval_s=0.0), publish(np.eye(4), interval_s=1e-9)):
        covariance = np.asarray(message["odom"].twist.covariance).reshape(6, 6)
        assert np.isfinite(covariance).all()
        assert covariance[0, 0] > 10.0**2


@pytest.mark.parametrize("refinement", [0.01, 0.25])
def test_a_translation_that_nothing_observes_is_as_unknown_whatever_the_refinement(refinement):
    sent = {}
    bus = SimpleNamespace(
        publish=lambda topic, message: sent.update({topic: message}),
        publish_if_heard=lambda topic, make: None,
    )
    result = FrameResult(OK, np.eye(4), COVARIANCE, 0, np.eye(4), 100, unobserved=0.7)
    PosePublisher(bus, FramesConfig(), refinement).publish(
        STAMP, result, odometry(), np.log(2.0), 0.0, np.zeros(3)
    )
    for topic in ("pose", "odom"):
        assert np.sqrt(np.diag(matrix(sent[topic]))[:3]) == pytest.approx([1.4] * 3, abs=1e-3)
        assert np.diag(matrix(sent[topic]))[3:].max() <= refinement * np.diag(COVARIANCE).max()


def test_drift_is_added_to_the_pose_and_the_walk_to_odometry():
    sent = {}
    bus = SimpleNamespace(
        publish=lambda topic, message: sent.update({topic: message}),
        publish_if_heard=lambda topic, make: sent.update({topic: make()}),
    )
    publisher = PosePublisher(bus, MOUNTED, refinement=0.25)
    result = FrameResult(OK, np.eye(4), COVARIANCE, 0, np.eye(4), 100)
    here, walk = Walk(4e-4, 9e-6), Walk(7e-4, 1e-5)
    publisher.publish(STAMP, result, odometry(), 0.0, 0.1, np.zeros(3), here, walk)
    own = 0.25 * matrix(publish(np.eye(4), MOUNTED)["pose"])
    # The camera drifts so: what turns it swings the base, which is about it as far as the mount says.
    base_from_camera = mount(MOUNTED)
    rng = np.random.default_rng(0)
    for topic, walk_of in (("pose", here), ("odom", walk)):
        sigmas, found = np.repeat(walk_of.sigmas(), 3), []
        for error in rng.normal(0.0, sigmas, (20000, 6)):
            turned, camera = so3_exp(error[3:]), base_from_camera[:3, 3]
            found.append(np.r_[camera + error[:3] - turned @ camera, error[3:]])
        added, sampled = matrix(sent[topic]) - own, np.cov(np.array(found).T)
        size = np.sqrt(np.outer(np.diag(added), np.diag(added)))
        assert np.abs((sampled - added) / size).max() < 0.03
