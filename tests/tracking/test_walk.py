"""The whole walk, which `odom` has, in closed form."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from prism_edge.config import CovarianceConfig
from prism_edge.geometry.poses import from_rt, so3_exp
from prism_edge.tracking.drift import Drift
from tests.tracking.cloud import pose_at
from tests.tracking.drifting import CONFIG, result

STEADY = CovarianceConfig(
    drift_of_motion=0.05, drift_per_sqrt_m=0.0, drift_per_sqrt_rad=0.0, turn_per_sqrt_m=0.01
)


def driven(drift: Drift, speed: float, seconds: float, metres: float = 1.0) -> None:
    """Along a line at 10 Hz, in a map whose unit is ``metres``."""
    last = None
    for k in range(round(10 * seconds) + 1):
        pose = pose_at(speed / metres * 0.1 * k)
        drift.advance(last, result(pose), np.log(metres), 100_000_000 * k)
        last = pose


@pytest.mark.parametrize("speed", [0.2, 1.5])
def test_a_second_s_motion_is_off_by_a_share_of_its_way_and_the_next_by_another(speed):
    one, many = Drift(STEADY), Drift(STEADY)
    driven(one, speed, 1.0, metres=2.0)
    driven(many, speed, 9.0)
    assert one.total.sigmas()[0] == pytest.approx(0.05 * speed)
    assert many.total.sigmas()[0] == pytest.approx(0.05 * speed * 3.0)
    assert many.total.sigmas()[1] == pytest.approx(0.01 * np.sqrt(9.0 * speed))


def test_what_keyframes_show_of_the_scale_here_is_added_to_the_share():
    drift = Drift(STEADY)
    drift.local_sigma = 0.12
    driven(drift, 0.5, 1.0)
    assert drift.total.sigmas()[0] == pytest.approx(0.13 * 0.5)


def test_what_was_seen_from_wider_apart_is_less_out_of_shape():
    config = CovarianceConfig(
        drift_of_motion=0.05, drift_per_sqrt_m=0.0, drift_per_sqrt_rad=0.01, turn_per_sqrt_m=0.0
    )
    for parallax_deg in (0.5, 4.0):
        drift, before = Drift(config), None
        for k in range(11):
            pose = from_rt(so3_exp(np.array([0, 0.02 * k, 0])), np.array([0, 0, 0.05 * k]))
            seen = replace(result(pose), parallax_deg=parallax_deg)
            drift.advance(before, seen, 0.0, 100_000_000 * k)
            before = pose
        metres, radians = drift.total.sigmas()
        assert metres == pytest.approx(0.05 / parallax_deg * 0.5)
        assert radians == pytest.approx(0.01 / parallax_deg * np.sqrt(0.2))
    drift.advance(None, replace(result(pose_at(0.5), 7, pose_at(0.5)), parallax_deg=2.0), 0.0, 1_100_000_000)
    assert drift.here.sigmas()[0] == pytest.approx(0.05 / 2.0 * 0.5), "by what is seen now"


def test_a_place_is_no_surer_for_standing_there():
    drift = Drift(STEADY)
    driven(drift, 0.0, 3.0)
    drift.advance(None, result(pose_at(0.4), 7, pose_at(0.4)), 0.0, 4_000_000_000)
    assert drift.here.sigmas()[0] == pytest.approx(0.05 * 0.4)
    drift.advance(None, result(pose_at(9.0), 7, pose_at(9.0)), 0.0, 4_000_000_000)
    assert drift.here.sigmas()[0] == pytest.approx(0.05 * 3.0)


def test_speed_is_an_average_of_a_second_and_a_gap_says_nothing_of_it():
    drift = Drift(STEADY)
    driven(drift, 1.0, 5.0)
    before = drift.total.metres2
    drift.advance(pose_at(5.0), result(pose_at(5.2)), 0.0, 5_100_000_000)  # 2 m/s for a tenth of a second
    speed = 1.0 + (1.0 - np.exp(-0.1)) / (1.0 - np.exp(-5.1))  # of all that it has seen
    assert drift.total.metres2 - before == pytest.approx(0.05**2 * speed * 0.2)
    before = drift.total.metres2
    drift.advance(pose_at(5.2), result(pose_at(15.2)), 0.0, 9_000_000_000)  # found again, far away
    assert drift.total.metres2 - before == pytest.approx(0.05**2 * speed * 10.0)


def test_a_way_that_nobody_saw_goes_on_as_fast_as_before_and_never_slower_than_a_hand():
    fast, slow = Drift(CONFIG), Drift(CONFIG)
    driven(fast, 2.0, 3.0, metres=0.5)
    driven(slow, 0.1, 3.0)
    for drift, speed in ((fast, 2.0), (slow, 0.5)):
        known = drift.total
        drift.miss(3.0)
        assert drift.total.metres2 - known.metres2 == pytest.approx((3.0 * speed) ** 2)
        assert drift.total.radians2 - known.radians2 == pytest.approx(1.5**2)
        drift.advance(np.eye(4), result(pose_at(0.2)), 0.0, 6_100_000_000)
        again = drift.total
        drift.miss(1.0)
        said = drift.total.metres2 - again.metres2
        assert said == pytest.approx(speed**2), "the step after it says nothing of the speed"


def test_how_far_it_was_carried_meanwhile_is_no_speed():
    jumped, stayed = Drift(STEADY), Drift(STEADY)
    for drift, metres in ((jumped, 5.0), (stayed, 0.0)):
        driven(drift, 1.0, 3.0)
        drift.miss(1.0)
        drift.advance(np.eye(4), result(pose_at(metres)), 0.0, 4_000_000_000)
        drift.miss(1.0)
    assert jumped._speed == stayed._speed == pytest.approx(1.0)


def test_the_way_after_one_that_nobody_saw_counts_from_there():
    drift = Drift(CONFIG)
    drift.advance(np.eye(4), result(pose_at(3.0)), 0.0, depth=2.0)
    drift.miss(1.0)
    unseen = drift.total.metres2
    drift.advance(np.eye(4), result(pose_at(0.01)), 0.0, depth=2.0)  # half of what is clearly moved
    assert drift.total.metres2 - unseen == pytest.approx(0.02**2 * 0.01)


def test_a_turn_goes_on_too_and_half_of_one_is_the_most():
    drift, turned = Drift(CONFIG), np.eye(4)
    for k in range(20):
        before, turned = turned, turned @ from_rt(so3_exp(np.array([0, 0.1, 0])), np.array([0, 0, 0.01]))
        drift.advance(before, result(turned), 0.0, 100_000_000 * k)
    known = drift.total.radians2
    drift.miss(2.0)
    assert drift.total.radians2 - known == pytest.approx(2.0**2)
    drift.miss(60.0)
    assert drift.total.radians2 - known == pytest.approx(2.0**2 + np.pi**2)


def test_the_way_goes_on_from_what_a_map_has_that_is_taken_over():
    drift = Drift(CONFIG)
    drift.advance(np.eye(4), result(pose_at(0.01)), 0.0, depth=2.0)
    drift.travelled = 7.0
    drift.advance(None, result(pose_at(40.0)), 0.0, depth=2.0)
    drift.advance(pose_at(40.0), result(pose_at(42.0)), 0.0, depth=2.0)
    assert drift.travelled == pytest.approx(9.0)


@pytest.mark.parametrize("rate", [1.0, 2.0, 10.0])
def test_a_slow_camera_is_as_unsure_of_its_way_as_a_fast_one(rate):
    """Per metre and by speed; and what nobody sees goes on at that speed."""
    sigmas = []
    for hz in (30.0, rate):
        drift, before = Drift(CovarianceConfig()), None
        for i in range(int(20 * hz) + 1):
            pose = pose_at(0.0, 0.0, 5.0 * i / hz)
            drift.advance(before, result(pose, 0, np.eye(4)), 0.0, round(i / hz * 1e9), 3.0)
            before = pose
        seen = drift.total.sigmas()[0]
        drift.miss(10.0)
        sigmas.append((seen, drift.total.sigmas()[0]))
    assert sigmas[1] == pytest.approx(sigmas[0], rel=0.1)
    assert sigmas[1][1] > 40.0
