"""When the tracker reckons with how the camera went: on the generated film, against the truth."""

from __future__ import annotations

import numpy as np

from prism_edge.geometry.poses import inverse, se3_log
from prism_edge.messages import DEGRADED, LOST, OK
from tests.tracking.film_run import BLACK, CONFIG, Run
from tests.tracking.footage import RATE_HZ, footage


def expectations(run: Run, frames: range) -> list[bool]:
    """Of each frame whether it was placed by what was expected of it, too."""
    said = []
    for i in frames:
        run.play(range(i, i + 1))
        assert run.tracker.last is not None
        said.append(run.tracker.last.expected is not None)
    return said


def test_the_points_of_one_keyframe_alone_foretell_nothing() -> None:
    """They are all off together, and with them how fast the camera seems to be."""
    run = Run()
    run.play(range(1), depth_for="first")
    alone = 0
    for i in range(1, 42):
        one = len(run.tracker.world.keyframes) < 2
        foretold = expectations(run, range(i, i + 1))[0]
        assert not (one and foretold)
        alone += one
    assert alone >= 1
    assert all(expectations(run, range(42, 60)))


def test_what_is_expected_is_where_the_camera_goes() -> None:
    run, truth, off = Run(), footage().poses, []
    run.play(range(30))
    for i in range(30, 60):
        run.play(range(i, i + 1))
        frame = run.tracker.last
        assert frame is not None and frame.expected is not None  # noqa: PT018
        start = inverse(truth[i - 1]) @ truth[i]  # what the camera did, from where the map had it
        shift = se3_log(inverse(frame.expected.world_from_camera) @ frame.world_from_camera)
        off.append(np.sqrt(shift @ frame.expected.information @ shift / 6.0))
        assert np.abs(se3_log(start)).max() < 0.1
    # Of deviations that are as large as they are said to be, the mean square is 1 at most.
    assert 0.05 < np.sqrt(np.mean(np.square(off))) < 1.5


def test_an_image_that_shows_nothing_stops_no_motion() -> None:
    run = Run()
    run.play(range(30))
    before = run.tracker.motion.twist.copy()
    assert run.feed(0, BLACK, at=30).odometry == DEGRADED
    assert np.array_equal(run.tracker.motion.twist, before)
    run.play(range(31, 32))
    assert run.results[31].odometry == OK
    assert run.tracker.last is not None and run.tracker.last.expected is not None  # noqa: PT018
    assert run.errors(range(31, 32))[0] < 0.04


def test_nothing_is_expected_of_a_camera_that_was_lost() -> None:
    run = Run()
    run.play(range(30))
    for i in range(30, 30 + round(CONFIG.lost_after_s * RATE_HZ) + 2):
        said = run.feed(0, BLACK, at=i).odometry
    assert said == LOST
    assert not run.tracker.motion.twist.any()
    run.until_found([(30 + j, None) for j in range(4)], at=i + 1)
    assert run.tracker.last is not None
    assert run.tracker.last.expected is None
