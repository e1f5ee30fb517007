"""A camera that goes on as it went."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from prism_edge.geometry.poses import Array, inverse, se3_exp, se3_log
from prism_edge.tracking import motion as motion_module
from prism_edge.tracking.motion import FIRST, LEAST, LETS_GO, LONGEST_S, ConstantVelocity, Prediction

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


def test_too_long_after_the_last_frame_it_stands() -> None:
    motion = ConstantVelocity()
    motion.follow(START, START @ se3_exp(np.full(6, 0.1)), SECOND // 10)
    last = SECOND // 10 + round(LONGEST_S * 1e9)
    assert not np.allclose(motion.predict(START, last - 1000), START)
    assert np.array_equal(motion.predict(START, last), START)


# -- how surely ---------------------------------------------------------------------------------

DT_NS, DT = 40_000_000, 0.04
DEPTH = 2.0
SPREAD = FIRST * np.repeat((DEPTH**2, 1.0), 3)  # density of the acceleration's noise, before any is learned


def begun(covariance: Array, rate: Array) -> tuple[ConstantVelocity, Array]:
    """A motion whose first two frames are DT apart, and the pose of the second."""
    motion, after = ConstantVelocity(), START @ se3_exp(rate * DT)
    motion._unit[:3] = DEPTH**2
    motion.follow(START, after, DT_NS, covariance)
    return motion, after


def test_a_prediction_is_as_wrong_as_it_says() -> None:
    """Against draws: two poses measured with noise, then acceleration like white noise in small steps."""
    rng, sigma = np.random.default_rng(5), np.array([2e-3, 1e-3, 3e-3, 1e-3, 2e-3, 1e-3])
    rate = np.array([0.3, -0.1, 0.5, 0.2, -0.4, 0.1])
    ahead_s, steps, off = 0.1, 20, []
    expected = None
    for _ in range(2000):
        motion, _ = begun(np.diag(sigma**2), rate)
        twist, true = rate.copy(), START
        fine = DT / steps  # the first two frames: as it is, but with accelerations between
        first = true @ se3_exp(sigma * rng.standard_normal(6))
        for _ in range(steps):
            true = true @ se3_exp(twist * fine)
            twist = twist + np.sqrt(SPREAD * fine) * rng.standard_normal(6)
        second = true @ se3_exp(sigma * rng.standard_normal(6))
        motion.follow(None, first, 0)
        motion._unit[:3] = DEPTH**2
        motion.follow(first, second, DT_NS, np.diag(sigma**2))
        fine = ahead_s / steps
        for _ in range(steps):
            true = true @ se3_exp(twist * fine)
            twist = twist + np.sqrt(SPREAD * fine) * rng.standard_normal(6)
        expected = motion.expect(second, DT_NS + round(ahead_s * 1e9), DEPTH)
        assert expected is not None
        off.append(se3_log(inverse(expected.world_from_camera) @ true))
    drawn = np.std(np.array(off), axis=0)
    said = np.sqrt(np.diag(np.linalg.inv(expected.information)))
    assert said == pytest.approx(drawn, rel=0.08)


def test_what_it_follows_is_what_least_squares_make_of_all_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    """Small motions, where poses add: pose, twist and both's covariance against one dense solution."""
    monkeypatch.setattr(motion_module, "LEARNED_S", np.inf)
    rng, frames, small = np.random.default_rng(1), 12, 1e-5
    sigma = small * np.array([2.0, 1.0, 3.0, 1.0, 2.0, 1.0])
    measured = small * np.cumsum(rng.standard_normal((frames, 6)), axis=0)
    covariance, motion = np.diag(sigma**2), ConstantVelocity()
    motion._density = FIRST * 1e-6
    density = motion._density * np.repeat((DEPTH**2, 1.0), 3)
    motion._unit[:3] = DEPTH**2
    motion.follow(None, se3_exp(measured[0]), 0)
    motion.follow(se3_exp(measured[0]), se3_exp(measured[1]), DT_NS, covariance)
    monkeypatch.setattr(motion_module, "LEAST", np.zeros(6))
    pose = se3_exp(measured[1])
    for n in range(2, frames):
        expected = motion.expect(pose, n * DT_NS, DEPTH)
        assert expected is not None
        ahead = se3_log(expected.world_from_camera)
        both = expected.information + np.linalg.inv(covariance)
        pose = se3_exp(np.linalg.solve(both, expected.information @ ahead + measured[n] / sigma**2))
        motion.follow(None, pose, n * DT_NS, covariance, expected)
    step = np.array([[DT**3 / 3.0, DT**2 / 2.0], [DT**2 / 2.0, DT]])
    for axis in range(6):
        # States (pose, twist) of the frames from the second on; rows: its beginning, the steps, the poses.
        normal, right = np.zeros((2 * (frames - 1), 2 * (frames - 1))), np.zeros(2 * (frames - 1))
        r = sigma[axis] ** 2
        began = np.linalg.inv([[r, r / DT], [r / DT, 2.0 * r / DT**2 + density[axis] * DT / 3.0]])
        normal[:2, :2] += began
        right[:2] += began @ [measured[1, axis], (measured[1, axis] - measured[0, axis]) / DT]
        for n in range(frames - 2):
            rows = np.zeros((2, 2 * (frames - 1)))
            rows[:, 2 * n : 2 * n + 2] = -np.array([[1.0, DT], [0.0, 1.0]])
            rows[:, 2 * n + 2 : 2 * n + 4] = np.eye(2)
            normal += rows.T @ np.linalg.inv(step * density[axis]) @ rows
            normal[2 * n + 2, 2 * n + 2] += 1.0 / r
            right[2 * n + 2] += measured[n + 2, axis] / r
        newest, beyond = np.linalg.solve(normal, right)[-2:], np.linalg.inv(normal)[-2:, -2:]
        assert se3_log(pose)[axis] == pytest.approx(newest[0], rel=1e-3, abs=1e-8)
        assert motion.twist[axis] == pytest.approx(newest[1], rel=1e-3, abs=1e-7)
        assert motion._joint is not None
        found = motion._joint[np.ix_([axis, axis + 6], [axis, axis + 6])]
        assert found == pytest.approx(beyond, rel=1e-2)


def test_nothing_is_expected_where_nothing_is_known() -> None:
    motion, after = begun(np.eye(6) * 1e-6, np.full(6, 0.1))
    assert motion.expect(after, DT_NS, DEPTH) is None  # no time has gone by
    assert motion.expect(after, DT_NS + round(LONGEST_S * 1e9), DEPTH) is None
    assert motion.expect(after, 2 * DT_NS, DEPTH) is not None
    assert motion.expect(after, 2 * DT_NS, float("nan")) is not None
    motion.stop()
    assert motion.expect(after, 2 * DT_NS, DEPTH) is None
    unsure, after = begun(np.diag([1e-6, 1e9, 1e-6, 1e-6, 1e-6, 1e-6]), np.full(6, 0.1))
    assert unsure.expect(after, 2 * DT_NS, DEPTH) is None


@pytest.mark.parametrize("by", [None, Prediction(START, np.eye(6))])
def test_a_frame_that_was_placed_without_it_begins_anew(by: Prediction | None) -> None:
    """Or by what was expected of another frame."""
    motion, after = begun(np.eye(6) * 1e-6, np.array([0.1, 0, 0, 0, 0, 0]))
    motion.expect(after, 2 * DT_NS, DEPTH)
    rate = np.array([-0.3, 0.0, 0.2, 0.0, 0.5, 0.0])
    motion.follow(after, after @ se3_exp(rate * DT), 2 * DT_NS, np.eye(6) * 1e-6, by)
    assert motion.twist == pytest.approx(rate, abs=1e-9)


def test_before_a_far_scene_a_camera_may_be_a_fast_one() -> None:
    motion, after = begun(np.eye(6) * 1e-12, np.full(6, 0.1))
    near, far = (motion.expect(after, 2 * DT_NS, depth) for depth in (DEPTH, 10.0 * DEPTH))
    assert near is not None
    assert far is not None
    less = np.diag(np.linalg.inv(far.information)) / np.diag(np.linalg.inv(near.information))
    assert np.all(less[:3] > 10.0)
    assert less[3:] == pytest.approx(np.ones(3))


def test_how_a_camera_speeds_up_is_learned() -> None:
    """One that goes on steadily is expected where it was: ever more surely, but never beyond what is set."""

    def after(density: float, frames: int) -> ConstantVelocity:
        rng, (motion, pose) = np.random.default_rng(2), begun(np.eye(6) * 1e-10, np.full(6, 0.1))
        rate, steps = np.full(6, 0.1), 10
        for n in range(2, frames):
            expected, before = motion.expect(pose, n * DT_NS, DEPTH), pose
            for _ in range(steps):
                rate = rate + np.sqrt(density * DT / steps) * rng.standard_normal(6)
                pose = pose @ se3_exp(rate * (DT / steps))
            motion.follow(before, pose, n * DT_NS, np.eye(6) * 1e-10, expected)
        return motion

    assert np.array_equal(after(0.0, 300)._density, LEAST)
    learned = after(2.0, 300)._density * np.repeat((DEPTH**2, 1.0), 3)
    assert np.all((learned > 1.0) & (learned < 4.0))


@pytest.mark.parametrize(("far", "within"), [(1e-5, 1e-3), (1e-3, 1e-2), (0.1, 0.5)])
def test_a_pull_is_the_slope_of_its_cost(far: float, within: float) -> None:
    """To first order in how far it is: there the twist of a small change is not what it adds."""
    rng = np.random.default_rng(3)
    root = rng.standard_normal((6, 6)) * 50.0
    expected = Prediction(START, root @ root.T)
    pose, h = START @ se3_exp(far * rng.standard_normal(6)), 1e-7
    _, information, gradient = expected.pull(pose)
    slope = np.array([
        (expected.pull(pose @ se3_exp(h * axis))[0] - expected.pull(pose @ se3_exp(-h * axis))[0]) / (4.0 * h)
        for axis in np.eye(6)
    ])
    assert np.linalg.norm(gradient - slope) < within * np.linalg.norm(slope)
    assert np.allclose(information, information.T)


def test_what_is_farther_than_both_could_err_lets_go() -> None:
    """Near by it is a square, far away it pulls less the farther it is."""
    expected = Prediction(START, np.eye(6) * 1e4)  # a centimetre

    def at(sigmas: float) -> tuple[float, Array, Array]:
        return expected.pull(START @ se3_exp(np.array([0.01 * sigmas, 0, 0, 0, 0, 0])))

    assert at(0.1)[0] == pytest.approx(0.01, rel=1e-2)
    assert at(0.1)[1] == pytest.approx(expected.information, rel=1e-2)
    pulls = [at(s)[2][0] for s in (1.0, LETS_GO, 3.0 * LETS_GO, 100.0 * LETS_GO)]
    assert pulls[0] < pulls[1] > pulls[2] > 10.0 * pulls[3]


def test_places_that_a_prediction_rules_out_are_those_of_a_thousandth_of_its_draws() -> None:
    rng = np.random.default_rng(3)
    root = rng.normal(size=(6, 6)) * 0.02
    expected = Prediction(START, np.linalg.inv(root @ root.T))
    out = [expected.rules_out(START @ se3_exp(root @ draw)) for draw in rng.normal(size=(20_000, 6))]
    assert np.mean(out) == pytest.approx(1e-3, abs=6e-4)


def test_a_prediction_goes_along_with_its_world() -> None:
    moved = se3_exp(np.array([3.0, -1.0, 2.0, 0.5, -0.7, 0.2]))
    expected, pose = Prediction(START, np.diag(np.arange(1.0, 7.0))), START @ se3_exp(np.full(6, 0.05))
    there = expected.carried(moved).pull(moved @ pose)
    for one, other in zip(expected.pull(pose), there, strict=True):
        assert one == pytest.approx(other)
