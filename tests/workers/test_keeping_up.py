"""Images that are dropped: when that is more than chance, and who is told."""

from __future__ import annotations

import pytest

from prism_edge.geometry.cameras import Camera
from prism_edge.workers.keeping_up import KeepingUp
from tests.workers.list_bus import ListBus
from tests.workers.tracker_bench import frame, run

CAMERA = Camera(1280, 720, 900.0, 900.0, 639.5, 359.5)
FRAME_NS = 33_333_333


class Stream:
    """Images at 30 Hz of which one in so many is taken."""

    def __init__(self) -> None:
        self.pulse = ListBus().pulse
        self.watch = KeepingUp(self.pulse)
        self.stamp_ns = 1_700_000_000_000_000_000

    def play(self, seconds: float, every: int = 1, frame_ns: int = FRAME_NS) -> str:
        for _ in range(round(seconds * 1e9 / (every * frame_ns))):
            self.stamp_ns += every * frame_ns
            self.watch.saw(self.stamp_ns, every - 1, CAMERA)
        return self.pulse.values.get("warning", "")


def test_a_computer_that_is_too_slow_is_said_once_on_the_log_and_while_it_lasts_on_health(
    caplog: pytest.LogCaptureFixture,
) -> None:
    stream = Stream()
    assert stream.play(9.0, every=2) == "", "it may yet be a moment"
    said = "50 % of the images were dropped: 1280x720 at their rate is more than this computer does"
    assert stream.play(12.0, every=2) == said
    assert stream.play(30.0, every=2) == said
    assert stream.play(21.0) == ""
    assert stream.play(21.0, every=3).startswith("67 %")
    assert caplog.text.count("were dropped") == 1


def test_a_moment_s_other_work_is_no_lack_of_speed() -> None:
    stream = Stream()
    for _ in range(10):
        assert stream.play(0.7, every=2) == ""
        assert stream.play(9.8) == ""


def test_a_pause_or_a_camera_that_is_away_says_nothing_of_speed() -> None:
    stream = Stream()
    stream.play(5.0)
    stream.stamp_ns += 3_600_000_000_000
    stream.watch.saw(stream.stamp_ns, 100_000, CAMERA)
    assert stream.play(25.0) == ""


def test_what_was_said_before_a_pause_does_not_stand_after_it() -> None:
    stream = Stream()
    assert stream.play(21.0, every=2)
    stream.stamp_ns += 3_600_000_000_000
    stream.watch.saw(stream.stamp_ns, 0, CAMERA)
    assert stream.pulse.values.get("warning", "") == ""


def test_stamps_of_another_clock_begin_anew() -> None:
    stream = Stream()
    stream.play(5.0, every=2)
    stream.stamp_ns -= 3_600_000_000_000
    assert stream.play(9.0) == ""
    assert stream.play(12.0) == ""


def test_of_a_slow_camera_a_single_image_is_no_share() -> None:
    assert Stream().play(120.0, every=2, frame_ns=1_000_000_000) == ""


@pytest.mark.parametrize("step", [1, 2])
def test_the_tracker_counts_what_it_never_saw(bus, world, step: int) -> None:
    """Thirty images in twelve seconds, of which with step 2 each other one was replaced by a newer."""
    run(bus, [frame(step * i, of=i % 12, stamp_ns=400_000_000 * i) for i in range(30)])
    assert ("% of the images were dropped" in bus.pulse.values.get("warning", "")) == (step == 2)
