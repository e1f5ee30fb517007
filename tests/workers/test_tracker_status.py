"""What `status` says of a map whose metres are doubtful, and of the next one."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from prism_edge.messages import (
    BUILDING,
    DEGRADED,
    INITIALISING,
    LOCALISED,
    LOOP_CLOSED,
    LOST,
    OK,
    RECOVERED,
    RELOCALISING,
)
from prism_edge.workers import tracker_status
from prism_edge.workers.tracker_status import TrackerStatus


def test_a_new_map_is_not_degraded_for_the_metres_of_the_one_before():
    bus = SimpleNamespace(publish=lambda topic, message: None, pulse=SimpleNamespace(values={}))
    status = TrackerStatus(bus)

    def said(epoch: int, stamp_ns: int) -> tuple[str, str]:
        status.show(epoch, OK, True, False, stamp_ns, {})
        return bus.pulse.values["odometry"], bus.pulse.values["depth"]

    assert said(0, 0) == (OK, "ok")
    for keyframe in range(5):
        status.metres.scale(keyframe, 0.8, accepted=False)
    assert said(0, 10**9) == (DEGRADED, "depth contradicts the scale")
    assert said(1, 2 * 10**9) == (OK, "ok")
    status.metres.depth(7, False, "dark")
    assert said(1, 3 * 10**9) == (DEGRADED, "no usable depth: dark")


def test_without_an_image_the_last_is_said_again_twice_a_second(monkeypatch: pytest.MonkeyPatch) -> None:
    now, said = [100.0], []
    monkeypatch.setattr(tracker_status.time, "monotonic", lambda: now[0])
    pulse = SimpleNamespace(values={})
    status = TrackerStatus(SimpleNamespace(publish=lambda topic, message: said.append(message), pulse=pulse))
    status.repeat()
    assert said == [], "there is nothing to say yet"
    for image in range(7):  # of a slow camera, which says it itself
        status.show(0, OK, True, False, image * 400_000_000, {})
        for _ in range(4):
            now[0] += 0.1
            status.repeat()
    stamps = [(m.header.stamp.sec, m.header.stamp.nanosec) for m in said]
    assert len(set(stamps)) == len(stamps) == 5, "a half second has one"
    for _ in range(8):
        now[0] += 0.25
        status.repeat()
    assert said[5:] == 4 * said[4:5], "0.75, 1.25, 1.75 and 2.25 s after the last image"


def test_a_map_that_stays_as_it_is_is_not_degraded_for_depth_that_never_came():
    bus = SimpleNamespace(publish=lambda topic, message: None, pulse=SimpleNamespace(values={}))
    status = TrackerStatus(bus)
    status.show(0, OK, True, False, 0, {})
    status.metres.keyframe(3, 0)
    status.show(0, OK, True, False, 6 * 10**9, {})
    assert bus.pulse.values["odometry"] == DEGRADED
    status.show(0, OK, True, True, 7 * 10**9, {})
    assert bus.pulse.values["odometry"] == OK


@pytest.mark.parametrize("word", [INITIALISING, DEGRADED, LOST])
def test_a_camera_that_is_not_well_is_so_whatever_its_metres_are(word):
    bus = SimpleNamespace(publish=lambda topic, message: None, pulse=SimpleNamespace(values={}))
    status = TrackerStatus(bus)
    status.show(0, OK, True, False, 0, {})
    status.metres.depth(7, False, "dark")
    status.show(0, word, True, False, 10**9, {})
    assert bus.pulse.values["odometry"] == word
    assert bus.pulse.values["depth"] == "no usable depth: dark"


def test_the_map_s_word_is_that_of_where_the_camera_is_and_for_a_while_what_has_happened():
    bus = SimpleNamespace(publish=lambda topic, message: None, pulse=SimpleNamespace(values={}))
    status = TrackerStatus(bus)

    def said(seconds: float, odometry: str = OK, at_home: bool = True, localise_only: bool = False) -> str:
        status.show(0, odometry, at_home, localise_only, round(seconds * 1e9), {})
        return bus.pulse.values["map"]

    assert said(0.0) == BUILDING
    assert said(1.0, localise_only=True) == LOCALISED
    assert said(2.0, LOST) == said(3.0, at_home=False) == RELOCALISING
    status.say(LOOP_CLOSED, 0, 4 * 10**9)
    assert said(4.0) == said(5.9) == said(5.0, localise_only=True) == LOOP_CLOSED
    assert said(5.5, at_home=False) == RELOCALISING
    assert said(6.0) == BUILDING


def test_what_has_happened_to_one_map_is_not_said_of_the_next():
    """After `reset` or `load_map`, a moment after a loop."""
    bus = SimpleNamespace(publish=lambda topic, message: None, pulse=SimpleNamespace(values={}))
    status = TrackerStatus(bus)

    def said(epoch: int, seconds: float, odometry: str = OK, localise_only: bool = False) -> str:
        status.show(epoch, odometry, True, localise_only, round(seconds * 1e9), {})
        return bus.pulse.values["map"]

    status.say(LOOP_CLOSED, 0, 10**9)
    assert said(0, 1.0) == LOOP_CLOSED
    assert said(1, 1.1, INITIALISING) == said(1, 1.2) == BUILDING
    assert said(1001, 1.3, localise_only=True) == LOCALISED
    status.say(RECOVERED, 2001, 2 * 10**9)  # before anything has been shown of that map
    assert said(2001, 2.0) == RECOVERED
