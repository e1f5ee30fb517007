"""How fast a camera is whose images are stamped by when they came."""

from __future__ import annotations

import numpy as np
import pytest

from prism_edge.config import CovarianceConfig
from prism_edge.geometry.poses import se3_exp
from prism_edge.tracking.drift import Drift
from prism_edge.tracking.motion import ConstantVelocity
from prism_edge.tracking.odometry import MetricOdometry
from prism_edge.tracking.pace import Pace
from tests.tracking.drifting import result

TWIST = np.array([0.4, 0.0, 0.3, 0.0, 0.5, 0.0])
T = 33_333_333


def came(kind: str, n: int = 60) -> list[int]:
    taken = [i * T for i in range(n)]
    if kind == "stall":
        return [t + 30_000_000 * (i % 15 == 14) for i, t in enumerate(taken)]
    k = int(kind)
    return [taken[i - i % k + k - 1] + 2_000_000 * (i % k) for i in range(n - n % k)]


@pytest.mark.parametrize("kind", ["2", "3", "stall"])
def test_images_that_come_together_are_no_leap(kind: str) -> None:
    odometry, motion, before = MetricOdometry(), ConstantVelocity(), None
    for i, stamp_ns in enumerate(came(kind)):
        pose = se3_exp(TWIST * (i * T * 1e-9))
        motion.pace.see(i, stamp_ns + 1)
        odometry.advance(before, pose, 0.0, stamp_ns + 1, motion.pace.longest_s)
        motion.follow(before, pose, stamp_ns + 1)
        before = pose
        if i > 30:
            assert odometry.twist == pytest.approx(TWIST, rel=0.35)
            assert motion.twist == pytest.approx(TWIST, rel=0.1)


@pytest.mark.parametrize("left_out", [{20}, {20, 21, 22}, set(range(20, 32)), set(range(0, 60, 3))])
def test_images_that_were_left_out_are_none_that_came_late(left_out: set[int]) -> None:
    pace = Pace()
    for i in range(60):
        if i not in left_out:
            pace.see(i, i * T + 1)
            assert pace.step_s == 0.0 == pace.longest_s


@pytest.mark.parametrize("before_ms", [100, 133, 40])
def test_a_camera_that_changes_its_rate_is_believed(before_ms: int) -> None:
    """As in better light, or a film whose rate varies."""
    motion, before, now_ns = ConstantVelocity(), np.eye(4), 1
    for i in range(80):
        now_ns += before_ms * 1_000_000 if i < 40 else 33_333_333
        pose = se3_exp(TWIST * (now_ns * 1e-9))
        motion.saw(i, now_ns, 0.0)
        motion.follow(before, pose, now_ns)
        before = pose
        assert i < 1 or motion.twist == pytest.approx(TWIST, rel=0.01)


def test_a_burst_after_a_wait_does_not_become_what_is_usual() -> None:
    pace, stamps = Pace(), [i * T for i in range(40)]
    waited = stamps[-1] + 20 * T  # nothing came meanwhile
    stamps += [waited + i * 1_000_000 for i in range(19)]
    stamps += [waited + i * T for i in range(1, 40)]
    for i, stamp_ns in enumerate(stamps):
        pace.see(i, stamp_ns + 1)
        if i > 65 and pace.step_s:
            assert pace.step_s == pytest.approx(T * 1e-9, rel=0.4)
    pace = Pace()
    for i in range(8):  # of a camera that was just connected
        pace.see(i, 1 + i * 1_000_000)
    for i in range(8, 60):
        pace.see(i, 1 + (i - 7) * T)
        assert not pace.step_s or pace.step_s == pytest.approx(T * 1e-9, rel=0.4)


def test_a_first_step_that_took_no_time_is_no_fast_camera() -> None:
    """Else `odom` is said to be decimetres off for the rest of the run."""
    sigmas = []
    for stamps in ([i * T for i in range(60)], came("2")):
        drift, before = Drift(CovarianceConfig()), None
        for i, stamp_ns in enumerate(stamps):
            pose = se3_exp(TWIST * (i * T * 1e-9))
            drift.advance(before, result(pose, 0, pose), 0.0, stamp_ns + 1, 2.0)
            before = pose
        sigmas.append(drift.total.sigmas()[0])
    assert sigmas[1] < 1.5 * sigmas[0]


def test_a_readout_longer_than_images_are_apart_is_wrongly_said() -> None:
    """Else 52 ms at 30 Hz are moved as 33, and nobody is told that they are not so."""
    motion, before = ConstantVelocity(), None
    for i in range(40):
        pose = se3_exp(TWIST * (i * T * 1e-9))
        motion.saw(i, i * T + 1, 0.052)
        motion.follow(before, pose, i * T + 1)
        before = pose
    assert motion.twist == pytest.approx(TWIST, rel=0.01)
