"""Metric odometry is continuous, whatever happens to map and scale."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from prism_edge.geometry.poses import inverse, scaled, se3_exp, se3_log
from prism_edge.tracking.odometry import ACCELERATION, GAP_S, MetricOdometry, unseen_motion
from tests.tracking.cloud import pose_at

twists = st.lists(st.floats(-0.5, 0.5), min_size=6, max_size=6).map(np.array)
SECOND = 1_000_000_000


@given(twists, st.lists(twists, min_size=1, max_size=8))
@settings(max_examples=40, deadline=None)
def test_without_corrections_it_is_the_pose_relative_to_the_first(first, steps):
    odometry, pose = MetricOdometry(), se3_exp(first)
    start = pose
    odometry.advance(None, pose, 0.0, 0)
    for i, step in enumerate(steps):
        after = pose @ se3_exp(step)
        odometry.advance(pose, after, 0.0, (i + 1) * SECOND)
        pose = after
    assert odometry.odom_from_camera == pytest.approx(inverse(start) @ pose, abs=1e-9)


@given(correction=twists, step=twists)
@settings(max_examples=40, deadline=None)
def test_a_corrected_map_does_not_make_it_jump(correction, step):
    """Between two frames the map moves; ``before`` is given as the corrected map has it."""
    plain, corrected = MetricOdometry(), MetricOdometry()
    at, after = pose_at(1.0, 0.2), pose_at(1.0, 0.2) @ se3_exp(step)
    moved = se3_exp(correction)
    for odometry in (plain, corrected):
        odometry.advance(None, pose_at(0.5), 0.0, 0)
        odometry.advance(pose_at(0.5), at, 0.0, SECOND)
    plain.advance(at, after, 0.0, 2 * SECOND)
    corrected.advance(moved @ at, moved @ after, 0.0, 2 * SECOND)
    assert corrected.odom_from_camera == pytest.approx(plain.odom_from_camera, abs=1e-9)


def test_a_new_scale_changes_only_what_is_to_come():
    odometry = MetricOdometry()
    odometry.advance(None, np.eye(4), 0.0, 0)
    odometry.advance(np.eye(4), pose_at(1.0), 0.0, SECOND)
    here = odometry.odom_from_camera.copy()
    odometry.advance(pose_at(1.0), pose_at(1.0), np.log(3.0), 2 * SECOND)
    assert odometry.odom_from_camera == pytest.approx(here)
    odometry.advance(pose_at(1.0), pose_at(1.5), np.log(3.0), 3 * SECOND)
    assert odometry.odom_from_camera[:3, 3] == pytest.approx([1.0 + 3 * 0.5, 0, 0])


def test_the_first_frame_in_another_map_goes_on_where_it_was_and_knows_no_velocity():
    odometry = MetricOdometry()
    odometry.advance(None, np.eye(4), 0.0, 0)
    odometry.advance(np.eye(4), pose_at(1.0), 0.0, SECOND)
    assert odometry.interval_s == 1.0
    here = odometry.odom_from_camera.copy()
    odometry.advance(None, pose_at(9.0), 0.0, 2 * SECOND)
    assert odometry.odom_from_camera.tolist() == here.tolist()
    assert odometry.interval_s == 0.0
    assert not odometry.twist.any()


def test_twist_is_per_second_in_the_camera_s_axes():
    odometry = MetricOdometry()
    odometry.advance(None, pose_at(0, 0, 0, 0, 1.0), 0.0, 0)
    assert not odometry.twist.any()
    step = np.array([0.1, 0.0, 0.05, 0.0, 0.02, 0.01])
    before = pose_at(0, 0, 0, 0, 1.0)
    odometry.advance(before, before @ se3_exp(step), np.log(2.0), SECOND // 10)
    metric = se3_log(scaled(se3_exp(step), 2.0))
    assert odometry.twist == pytest.approx(10 * metric)
    assert odometry.interval_s == pytest.approx(0.1)


def test_no_time_no_twist():
    odometry = MetricOdometry()
    odometry.advance(None, np.eye(4), 0.0, SECOND)
    odometry.advance(np.eye(4), pose_at(0.1), 0.0, SECOND)
    assert not odometry.twist.any()
    assert odometry.interval_s == 0.0


def test_a_step_after_copies_takes_their_time_too():
    """Nobody asks it of an exact copy: the camera's way since goes over both periods."""
    odometry = MetricOdometry()
    odometry.advance(None, np.eye(4), 0.0, 0)
    odometry.advance(np.eye(4), pose_at(0.1), 0.0, SECOND)
    odometry.advance(pose_at(0.1), pose_at(0.3), 0.0, 3 * SECOND)
    assert odometry.twist[0] == pytest.approx(0.1)
    assert odometry.interval_s == pytest.approx(2.0)


def test_a_velocity_holds_for_a_few_copies_and_is_then_unknown():
    odometry = MetricOdometry()
    odometry.repeat(0)  # nothing was there to copy: harmless
    odometry.advance(None, np.eye(4), 0.0, 0)
    odometry.advance(np.eye(4), pose_at(0.1), 0.0, SECOND // 10)
    for tenths in (2, 3):
        odometry.repeat(tenths * SECOND // 10)
        assert (odometry.twist[0], odometry.interval_s) == pytest.approx((1.0, 0.1))
    odometry.repeat(4 * SECOND // 10)
    assert not odometry.twist.any()
    assert odometry.interval_s == 0.0
    # How long the way after it took is not known: the camera may have hung, or stood.
    odometry.advance(pose_at(0.1), pose_at(0.3), 0.0, 5 * SECOND // 10)
    assert odometry.odom_from_camera[0, 3] == pytest.approx(0.3)
    assert odometry.interval_s == 0.0
    odometry.advance(pose_at(0.3), pose_at(0.4), 0.0, 6 * SECOND // 10)
    assert (odometry.twist[0], odometry.interval_s) == pytest.approx((1.0, 0.1))


def test_of_a_fast_camera_it_holds_for_a_tenth_of_a_second():
    odometry = MetricOdometry()
    odometry.advance(None, np.eye(4), 0.0, 0)
    odometry.advance(np.eye(4), pose_at(0.1), 0.0, SECOND // 100)
    for hundredths, known in ((3, True), (11, True), (12, False)):
        odometry.repeat(hundredths * SECOND // 100)
        assert odometry.twist.any() == known


def test_after_a_loss_the_way_counts_and_the_velocity_is_unknown():
    odometry = MetricOdometry()
    odometry.advance(None, np.eye(4), 0.0, 0)
    odometry.lose()
    odometry.advance(np.eye(4), pose_at(2.0), 0.0, SECOND)
    assert odometry.odom_from_camera[0, 3] == pytest.approx(2.0)
    assert (odometry.interval_s, odometry.twist.any()) == (0.0, False)
    odometry.advance(pose_at(2.0), pose_at(3.0), 0.0, 2 * SECOND)
    assert (odometry.twist[0], odometry.interval_s) == pytest.approx((1.0, 1.0))


@pytest.mark.parametrize("pace_s", [1 / 30, 0.5, 1.0])
def test_where_images_were_missing_the_way_counts_and_the_velocity_is_unknown(pace_s):
    """However far the camera went meanwhile, and though each image was tracked; a slow camera misses none."""
    odometry, at_s, x = MetricOdometry(), 0.0, 0.0
    odometry.advance(None, np.eye(4), 0.0, 0)
    for elapsed_s, known in [(pace_s, True), (pace_s, True), (10.0, False), (pace_s, True)]:
        before, at_s, x = x, at_s + elapsed_s, x + 0.1
        odometry.advance(pose_at(before), pose_at(x), 0.0, round(at_s * SECOND))
        assert odometry.odom_from_camera[0, 3] == pytest.approx(x)
        assert odometry.interval_s == pytest.approx(elapsed_s if known else 0.0)
        assert odometry.twist[0] == pytest.approx(0.1 / elapsed_s if known else 0.0)


def test_it_stays_a_rigid_pose_over_thousands_of_steps():
    odometry, step = MetricOdometry(), pose_at(0.001, 0.0, 0.002, 0.01, -0.02, 0.005)
    for _ in range(5_000):
        odometry.advance(np.eye(4), step, 0.0, 0)
    rotation = odometry.odom_from_camera[:3, :3]
    assert np.abs(rotation @ rotation.T - np.eye(3)).max() < 1e-14


def test_where_a_camera_went_that_nobody_saw_is_within_what_is_said():
    """A steady camera is a sigma away along its way; one whose velocity changes, as far as that takes it."""
    twist, interval_s, elapsed_s = np.array([0.6, 0.0, 0.8, 0.0, 0.5, 0.0]), 0.1, 0.06
    stated = unseen_motion(twist, interval_s, elapsed_s)
    rng, gone = np.random.default_rng(0), []
    for acceleration in rng.normal(0.0, ACCELERATION, (4000, 6)):
        # Known at the middle of the interval, it has changed since, and goes on changing.
        at_last = twist + acceleration * interval_s / 2.0
        gone.append(at_last * elapsed_s + acceleration * elapsed_s**2 / 2.0)
    found = np.einsum("ni,nj->ij", np.array(gone), np.array(gone)) / len(gone)
    assert np.abs(found - stated).max() < 0.05 * stated.max()
    assert np.linalg.eigvalsh(stated)[0] > 0.0


def test_of_a_camera_that_stood_or_only_turned_nothing_says_that_it_went():
    assert not unseen_motion(np.zeros(6), 0.1, 1.0).any()
    turning = unseen_motion(np.array([0.0, 0.0, 0.0, 0.0, 0.5, 0.0]), 0.1, 0.2)
    assert not turning[:3].any()
    assert turning[4, 4] > (0.5 * 0.2) ** 2


def test_what_nobody_saw_grows_for_a_second_and_ends_with_the_next_image():
    odometry = MetricOdometry()
    odometry.repeat(0)  # nothing was there to copy: harmless
    assert not odometry.unseen.any()
    odometry.advance(None, np.eye(4), 0.0, 0)
    odometry.advance(np.eye(4), pose_at(0.05), 0.0, SECOND // 10)
    sigmas = []
    for tenths in (2, 6, 11, 12, 30):
        odometry.repeat(tenths * SECOND // 10)
        sigmas.append(np.sqrt(odometry.unseen[0, 0]))
    assert sigmas[0] == pytest.approx(np.hypot(0.05, 0.1 * 0.1))
    assert sigmas[0] < sigmas[1] < sigmas[2] == sigmas[3] == sigmas[4]
    odometry.advance(pose_at(0.05), pose_at(0.06), 0.0, 31 * SECOND // 10)
    assert not odometry.unseen.any()


@pytest.mark.parametrize("dropped", [3, 10])
def test_a_velocity_is_known_over_a_few_dropped_images(dropped: int) -> None:
    """At 30 Hz a gap of up to half a second still says how fast the camera is."""
    odometry, frame_ns = MetricOdometry(), 33_333_333
    for k in range(4):
        odometry.advance(pose_at(0.01 * (k - 1)) if k else None, pose_at(0.01 * k), 0.0, frame_ns * k)
    gap = (dropped + 1) * frame_ns
    assert gap * 1e-9 < GAP_S
    odometry.advance(pose_at(0.03), pose_at(0.13), 0.0, frame_ns * 3 + gap)
    assert odometry.interval_s == pytest.approx(gap * 1e-9)
    assert odometry.twist[0] == pytest.approx(0.1 / (gap * 1e-9))
    assert np.abs(odometry.twist[1:]).max() < 1e-9


def test_where_images_come_together_a_velocity_is_of_what_came_after_another_map_began_alone():
    """Nobody knows the way to its first frame: as part of the steps it would be a camera that stood."""
    odometry, tenth = MetricOdometry(), SECOND // 10
    odometry.advance(None, np.eye(4), 0.0, 0, longer_s=0.5)
    for i in (1, 2, 3):
        odometry.advance(pose_at(0.1 * (i - 1)), pose_at(0.1 * i), 0.0, i * tenth, longer_s=0.5)
    odometry.advance(None, pose_at(9.0), 0.0, 6 * tenth, longer_s=0.5)
    odometry.advance(pose_at(9.0), pose_at(9.1), 0.0, 7 * tenth, longer_s=0.5)
    assert odometry.twist[0] == pytest.approx(1.0)
    assert odometry.interval_s == pytest.approx(0.1)
