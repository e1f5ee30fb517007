"""A prediction's doubt is carried along by the motion, and what learning a speed-up takes of each frame."""

from __future__ import annotations

import numpy as np
import pytest

from prism_edge.geometry.poses import inverse, se3_exp, se3_log
from prism_edge.tracking.motion import LONGEST_S, MOST_AT_ONCE, ConstantVelocity

START = se3_exp(np.array([1.0, -2.0, 0.5, 0.3, 0.1, -0.2]))


def test_a_turning_camera_s_doubt_turns_with_it() -> None:
    """A pose that is unsure along z alone is so along another of its own axes a quarter of a turn later."""
    rng, ahead_s = np.random.default_rng(2), 0.5
    sigma = np.array([1e-4, 1e-4, 1e-2, 1e-5, 1e-5, 1e-5])
    rate = np.array([0.5, 0.0, 0.3, 0.0, np.pi, 0.0])
    motion = ConstantVelocity()
    motion.twist, motion._joint = rate, np.zeros((12, 12))
    motion._joint[:6, :6] = np.diag(sigma**2)
    motion._density = np.full(6, 1e-12)
    expected = motion.expect(START, round(ahead_s * 1e9), 2.0)
    assert expected is not None
    off = []
    for _ in range(4000):
        true = START @ se3_exp(sigma * rng.standard_normal(6)) @ se3_exp(rate * ahead_s)
        off.append(se3_log(inverse(expected.world_from_camera) @ true))
    drawn, said = np.cov(np.array(off).T), np.linalg.inv(expected.information)
    assert said[:3, :3] == pytest.approx(drawn[:3, :3], abs=5e-6)
    assert np.sqrt(said[0, 0]) == pytest.approx(1e-2, rel=0.05), "what was ahead is beside it now"
    forth = motion.expect(START, round(0.5 * ahead_s * 1e9), 2.0)
    assert forth is not None
    eighth = np.linalg.inv(forth.information)
    turn = se3_exp(rate * -0.5 * ahead_s)[:3, :3]
    turned = turn @ np.diag(sigma[:3] ** 2) @ turn.T
    assert eighth[:3, :3] == pytest.approx(turned, abs=2e-6)


def test_frames_that_tell_next_to_nothing_teach_nothing_of_how_the_camera_speeds_up() -> None:
    """A second behind somebody: each frame is placed where it was expected, for want of anything else."""
    motion, now, rate = ConstantVelocity(), START, np.array([0.5, 0.0, 0.3, 0.0, 0.4, 0.0])
    motion.follow(None, now, 0)
    after = now @ se3_exp(rate / 25.0)
    motion.follow(now, after, 40_000_000, np.eye(6) * 1e-6)
    before = motion._density.copy()
    for k in range(2, 27):
        expected = motion.expect(after, 40_000_000 * k, 2.0)
        assert expected is not None
        after = expected.world_from_camera
        motion.follow(None, after, 40_000_000 * k, np.eye(6) * 1e4, expected)
    assert motion._density == pytest.approx(before, rel=0.02)


def test_of_a_camera_that_has_just_been_found_nothing_is_expected() -> None:
    """Not that it stands: its first frame says where it is, and nothing of where it goes."""
    motion = ConstantVelocity()
    motion.follow(None, START, 0)
    motion.follow(None, START, 40_000_000, np.eye(6) * 1e-6)
    assert motion.expect(START, 80_000_000, 2.0) is None


@pytest.mark.parametrize(("apart_s", "known"), [(LONGEST_S - 0.01, True), (LONGEST_S, False)])
def test_two_frames_long_apart_say_nothing_of_how_fast_a_camera_is(apart_s: float, known: bool) -> None:
    motion = ConstantVelocity()
    motion.follow(None, START, 0)
    motion.follow(START, START @ se3_exp(np.full(6, 0.1)), round(apart_s * 1e9), np.eye(6) * 1e-6)
    assert motion.twist.any() == known
    assert (motion.expect(START, round((apart_s + 0.04) * 1e9), 2.0) is not None) == known


@pytest.mark.parametrize("depth", [0.0, np.inf, np.nan])
def test_where_nothing_says_how_far_the_scene_is_it_may_be_a_metre(depth: float) -> None:
    """Else a camera would be as good as nailed down, or anywhere."""
    motion = ConstantVelocity()
    motion.follow(None, START, 0)
    motion.follow(START, START @ se3_exp(np.full(6, 0.02)), 40_000_000, np.eye(6) * 1e-6)
    vague, said = (motion.expect(START, 80_000_000, of) for of in (depth, 1.0))
    assert vague is not None
    assert said is not None
    assert vague.information == pytest.approx(said.information)


def test_one_leap_teaches_no_more_than_so_much_of_how_the_camera_speeds_up() -> None:
    """A camera that was knocked, or a frame that was placed wrongly, is soon followed as before."""
    motion, step = ConstantVelocity(), se3_exp(np.full(6, 0.02))
    motion.follow(None, START, 0)
    after = START @ step
    motion.follow(START, after, 40_000_000, np.eye(6) * 1e-6)
    before = motion._density.copy()
    expected = motion.expect(after, 80_000_000, 2.0)
    assert expected is not None
    leap = expected.world_from_camera @ se3_exp(np.array([3.0, 0.0, 0.0, 0.0, 2.0, 0.0]))
    motion.follow(after, leap, 80_000_000, np.eye(6) * 1e-6, expected)
    grown = motion._density / before
    assert (grown > 1.0).all()
    assert (grown < np.exp(0.04 / 0.3 * MOST_AT_ONCE)).all()
