"""A camera that goes on as it went."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from prism_edge.geometry.poses import se3_exp
from prism_edge.tracking.motion import LONGEST_S, ConstantVelocity

SECOND = 1_000_000_000
START = se3_exp(np.array([1.0, -2.0, 0.5, 0.3, 0.1, -0.2]))


@given(
    st.lists(st.floats(-2.0, 2.0), min_size=6, max_size=6),
    st.floats(0.01, 0.4),
    st.floats(-0.5, 0.5),
)
def test_a_steady_twist_goes_on(twist: list[float], elapsed_s: float, ahead_s: float) -> None:
    """On one screw: at any moment the camera is where exp(twist t) has it."""
    motion, rate = ConstantVelocity(), np.array(twist)
    motion.stamp_ns = 5 * SECOND
    now = motion.stamp_ns + round(elapsed_s * 1e9)
    after = START @ se3_exp(rate * ((now - motion.stamp_ns) * 1e-9))
    motion.follow(START, after, now)
    then = now + round(ahead_s * 1e9)
    expected = after @ se3_exp(rate * ((then - now) * 1e-9))
    assert motion.predict(after, then) == pytest.approx(expected, abs=1e-8)


@pytest.mark.parametrize("elapsed_s", [0.0, -0.1, LONGEST_S, 3.0])
def test_frames_that_say_nothing_of_the_motion_stop_it(elapsed_s: float) -> None:
    motion = ConstantVelocity()
    motion.follow(START, START @ se3_exp(np.full(6, 0.1)), SECOND // 10)
    assert not np.allclose(motion.predict(START, SECOND // 5), START)
    stamp_ns = SECOND // 10 + round(elapsed_s * 1e9)
    motion.follow(START, START @ se3_exp(np.full(6, 0.1)), stamp_ns)
    assert np.array_equal(motion.predict(START, stamp_ns + SECOND), START)


def test_without_a_frame_before_or_told_to_it_stands() -> None:
    motion = ConstantVelocity()
    motion.follow(None, START, SECOND)
    assert np.array_equal(motion.predict(START, 2 * SECOND), START)
    motion.follow(START, START @ se3_exp(np.full(6, 0.1)), SECOND + SECOND // 10)
    motion.stop()
    assert np.array_equal(motion.predict(START, 2 * SECOND), START)
