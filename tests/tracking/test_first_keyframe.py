"""How long a first keyframe is waited for: the rules, and a tracker that follows them."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from prism_edge.messages import INITIALISING, OK
from prism_edge.tracking import first_keyframe
from prism_edge.tracking.first_keyframe import (
    DEPTH_PATIENCE_S,
    MOST_PATIENCE_S,
    RETRY_S,
    TRACKING_PATIENCE_S,
    FirstKeyframe,
)
from prism_edge.tracking.first_map import SecondView
from prism_edge.tracking.tracker import Tracker
from tests.tracking.film_run import BLACK, CONFIG, Run
from tests.tracking.footage import IDENTITY, footage, other_room

MS = 1_000_000
NOTHING = np.zeros((240, 320), np.float32)


def gives_way_after(first: FirstKeyframe, since_ms: int) -> int:
    """Milliseconds until it does, asked every 10 ms."""
    return next(ms for ms in range(0, 60_000, 10) if first.gives_way((since_ms + ms) * MS))


def test_without_an_answer_it_stays_for_long() -> None:
    first = FirstKeyframe()
    first.begin(3, 500 * MS)
    assert gives_way_after(first, 500) == pytest.approx(1000 * DEPTH_PATIENCE_S, abs=10)


def test_from_its_depth_on_it_has_a_while_however_late_that_came() -> None:
    first = FirstKeyframe()
    first.begin(3, 0)
    assert not first.gives_way(6_000 * MS)
    first.has_depth()
    assert gives_way_after(first, 6_000) == pytest.approx(1000 * TRACKING_PATIENCE_S, abs=10)


def test_without_use_it_goes_soon_and_the_next_ones_later_and_later() -> None:
    first, waited = FirstKeyframe(), []
    for k in range(9):
        first.begin(k, 0)
        first.has_no_depth(k)
        waited.append(gives_way_after(first, 0))
    assert waited[0] == pytest.approx(1000 * RETRY_S, abs=10)
    assert waited[1] == pytest.approx(2 * waited[0], abs=10)
    assert waited == sorted(waited)
    assert waited[-1] == pytest.approx(1000 * DEPTH_PATIENCE_S, abs=10)
    first.begin(9, 0)
    first.has_depth()
    first.begin(10, 0)
    first.has_no_depth(10)
    assert gives_way_after(first, 0) == waited[0], "the network is in order"


def test_others_depth_says_nothing_of_it() -> None:
    first = FirstKeyframe()
    first.begin(3, 0)
    first.has_no_depth(2)
    assert not first.gives_way(5_000 * MS)
    first.has_depth()
    first.has_no_depth(3)
    assert not first.gives_way(5_500 * MS)


def test_an_answer_that_came_too_late_says_how_long_the_next_one_takes() -> None:
    first = FirstKeyframe()
    first.begin(3, 0)
    assert first.gives_way(10_500 * MS)
    first.begin(4, 10_500 * MS)
    assert not first.gives_way(14_000 * MS)
    first.heard(4)  # of the one that waits: that is has_depth's affair
    first.heard(99)
    assert gives_way_after(first, 10_500) == pytest.approx(1000 * DEPTH_PATIENCE_S, abs=10)
    first.begin(5, 30_000 * MS)
    assert not first.gives_way(34_000 * MS)
    first.heard(3)  # after 34 s
    assert not first.gives_way(97_000 * MS)
    assert first.gives_way(99_000 * MS)


def test_nobody_waits_for_ever() -> None:
    first = FirstKeyframe()
    first.begin(3, 0)
    assert first.gives_way(900_000 * MS)
    first.heard(3)
    first.begin(4, 900_000 * MS)
    assert first.gives_way(900_000 * MS + round(1.001 * MOST_PATIENCE_S * 1000) * MS)


def test_why_it_gave_way_is_said_once_until_a_map_has_begun(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Without a network, or before a wall, one gives way to another for as long as the daemon runs."""
    caplog.set_level("INFO")
    monkeypatch.setattr(first_keyframe, "begin_structure", lambda *_: SecondView.AGREES)
    first, nobody = FirstKeyframe(), SimpleNamespace(matched=200)

    def gave_way(times: int, answer: Any = lambda _: None) -> list[str]:
        caplog.clear()
        for number in range(times):
            first.begin(number, 0)
            answer(number)
            assert first.gives_way(60_000 * MS)
        return caplog.messages

    ends = "it gives way"
    assert gave_way(5) == [f"the first keyframe has had no depth: {ends}"]
    assert gave_way(5, first.has_no_depth) == [f"the first keyframe has depth of no use: {ends}"]
    could_not = gave_way(5, lambda _: first.has_depth())
    assert could_not == [f"the first keyframe could not be tracked: {ends}"]
    assert gave_way(2, lambda _: first.has_depth()) == gave_way(2) == []
    first.second_view(nobody, nobody, nobody, 0, 0)  # type: ignore[arg-type]
    assert len(gave_way(2, lambda _: first.has_depth())) == 1


@pytest.mark.parametrize("takes_s", [9.5, 12.5])
def test_a_map_begins_however_long_the_network_takes_for_a_picture(takes_s: float) -> None:
    """It works on the newest picture, one after the other, and answers for maps that were given up too."""
    run, busy, newest, heard = Run(), None, None, 0
    for at in range(0, 3 * 30 * 15, 15):  # two images a second
        if busy is not None and at >= busy[1]:
            keyframe, epoch = busy[0], busy[2]
            run.tracker.first.heard(keyframe)
            if epoch == run.tracker.epoch:
                heard += run.tracker.add_depth(keyframe, footage().depths[0], IDENTITY, 0.1) > 0
            busy = None
        known = set(run.keyframes)
        result = run.feed(0, at=at)
        for keyframe in set(run.keyframes) - known:
            newest = keyframe, run.tracker.epoch
        if busy is None and newest is not None:
            busy, newest = (newest[0], at + 30 * takes_s, newest[1]), None
        if result.odometry == OK:
            break
    assert result.odometry == OK
    assert heard == 1
    assert run.tracker.epoch == (takes_s > DEPTH_PATIENCE_S)


@pytest.mark.parametrize("answer", ["invalid", "nowhere of use"])
def test_a_first_image_whose_depth_is_of_no_use_costs_a_moment(
    answer: str, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    run = Run()
    run.feed(0)
    if answer == "invalid":
        run.tracker.add_no_depth(0)
    else:
        assert run.tracker.add_depth(0, NOTHING, IDENTITY, 0.1) == 0
        assert "depth gives 0 points: too few" in caplog.text
    at = 1
    while len(run.keyframes) < 2 and at < 30:
        assert run.feed(at).odometry == INITIALISING
        at += 1
    assert at <= RETRY_S * 30 + 3
    assert run.tracker.epoch == 1
    run.depth(max(run.keyframes))
    assert run.feed(at).odometry == OK


def test_slow_depth_that_is_followed_by_a_blurred_image_is_not_thrown_away() -> None:
    run = Run()
    for i in range(55):
        run.feed(0, at=i)
    assert run.depth(0) > 100
    for i in range(55, 60):
        assert run.feed(0, BLACK, at=i).odometry == INITIALISING
    assert run.feed(0, at=60).odometry == OK
    assert run.tracker.epoch == 0


def astray(room: list[tuple[np.ndarray, ...]]) -> Run:
    """A camera that was carried to another room, and begins a part of the map there."""
    run = Run(tracker=Tracker(replace(CONFIG, submap_after_s=0.3)))
    run.play(range(30))
    for i in range(30, 42):
        run.feed(0, BLACK, at=i)
    while max(run.keyframes.values()) < 42:
        run.feed(0, room[0][0], at=max(run.results) + 1)
    return run


def test_a_part_whose_depth_is_of_no_use_begins_again_soon() -> None:
    room = other_room(40)
    run = astray(room)
    part = max(run.keyframes)
    run.tracker.add_no_depth(part)
    began = max(run.results)
    while max(run.keyframes) == part:
        run.feed(0, room[0][0], at=max(run.results) + 1)
        assert max(run.results) <= began + RETRY_S * 30 + 3
    assert part not in run.tracker.world.keyframes
    run.tracker.add_depth(max(run.keyframes), room[0][1], IDENTITY, 0.1)
    assert run.feed(0, room[1][0], at=max(run.results) + 1).odometry == OK


def test_in_the_dark_a_part_gives_way_to_none_and_the_first_light_begins_one() -> None:
    room = other_room(40)
    run = astray(room)
    part = max(run.keyframes)
    run.tracker.add_no_depth(part)
    for _ in range(60):
        run.feed(0, BLACK, at=max(run.results) + 1)
    assert max(run.keyframes) == part
    assert part not in run.tracker.world.keyframes
    run.feed(0, room[0][0], at=max(run.results) + 1)
    begun = max(run.keyframes)
    assert begun > part
    run.tracker.add_depth(begun, room[0][1], IDENTITY, 0.1)
    assert run.feed(0, room[1][0], at=max(run.results) + 1).odometry == OK


def test_no_probe_takes_the_place_of_the_picture_that_a_part_waits_for() -> None:
    """The depth worker keeps the newest picture alone: a slow network would see probes only."""
    room = other_room(40)
    run = astray(room)
    part = max(run.keyframes)
    for _ in range(30):
        run.feed(0, room[0][0], at=max(run.results) + 1)
        assert not run.tracker.wants_probe
    assert max(run.keyframes) == part


def test_once_its_depth_is_of_no_use_a_part_waits_for_nothing() -> None:
    room = other_room(40)
    run = astray(room)
    part = max(run.keyframes)
    run.tracker.add_no_depth(part)
    run.feed(0, room[0][0], at=max(run.results) + 1)
    assert max(run.keyframes) == part, "another begins a moment later"
    assert run.tracker.wants_probe


def test_where_no_part_may_be_mapped_none_is_waited_for() -> None:
    room = other_room(40)
    run = astray(room)
    run.tracker.may_map = False
    run.feed(0, room[0][0], at=max(run.results) + 1)
    assert run.tracker.wants_probe


def test_a_part_of_slow_depth_is_not_lost_with_the_first_blurred_image() -> None:
    room = other_room(40)
    run = astray(room)
    part = max(run.keyframes)
    for _ in range(60):
        run.feed(0, room[0][0], at=max(run.results) + 1)
    run.tracker.add_depth(part, room[0][1], IDENTITY, 0.1)
    run.feed(0, BLACK, at=max(run.results) + 1)
    assert run.feed(0, room[1][0], at=max(run.results) + 1).odometry == OK
    assert max(run.keyframes) == part


def test_the_film_is_not_what_they_wait_for() -> None:
    """Guard: the film's own first depth begins a map at once."""
    run = Run()
    run.feed(0)
    assert run.tracker.add_depth(0, footage().depths[0], IDENTITY, 0.1) > 100
    assert run.feed(1).odometry == OK


def test_a_second_view_from_too_near_is_not_looked_at_again_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """A camera that turns on the spot: each look costs more than tracking."""
    asked: list[int] = []
    said = [SecondView.TOO_NEAR]

    def look(world: object, first_: object, frame: SimpleNamespace, seed: int) -> SecondView:
        asked.append(frame.stamp_ns)
        return said[0]

    monkeypatch.setattr(first_keyframe, "begin_structure", look)
    first = FirstKeyframe()
    first.begin(0, 0)

    def see(ms: int, matched: int = 300) -> SecondView:
        frame: Any = SimpleNamespace(stamp_ns=ms, matched=matched)
        nothing: Any = None
        return first.second_view(nothing, nothing, frame, 0, ms * MS)

    for ms in range(0, 400, 33):
        assert see(ms) is SecondView.TOO_NEAR
    assert asked == [0, 132, 264, 396]
    see(400, matched=99)  # about to lose the first view: no time to wait
    assert asked[-1] == 400
    said[0] = SecondView.AGREES
    assert see(450) is SecondView.TOO_NEAR
    assert see(501) is SecondView.AGREES
    first.begin(7, 510 * MS)
    assert see(511) is SecondView.AGREES
    assert asked[-2:] == [501, 511]
    said[0] = SecondView.TOO_NEAR
    see(600)
    see(30)
    assert asked[-2:] == [600, 30], "a clock that was set back is not waited for"
