"""In real time frames are tracked while a keyframe joins the map; nothing of it shows but their time."""

from __future__ import annotations

import numpy as np
import pytest

from prism_edge.tracking import tracker
from tests.workers.list_bus import ListBus
from tests.workers.tracker_bench import LOCKSTEP, World, frame, positions, run, true_position

FRAMES = 60


@pytest.fixture
def busy(bus: ListBus, world: object) -> ListBus:
    """A bus on which each frame is there before the last one is done with."""
    bus.in_time = False
    return bus


def test_frames_that_wait_are_tracked_before_the_keyframe_is_told(busy: ListBus) -> None:
    run(busy, [frame(i) for i in range(FRAMES)])
    order = [(t, m.index) for t, m in busy.sent if t in ("keyframe", "tracked")]
    keyframes = [k.index for k in busy.of("keyframe")]
    later = keyframes[1:]
    assert later
    for index in later:
        between = order[order.index(("tracked", index)) + 1 : order.index(("keyframe", index))]
        assert between == [("tracked", index + 1), ("tracked", index + 2)]
    assert [m.index for m in busy.of("tracked")] == list(range(FRAMES))


def test_none_of_them_becomes_a_keyframe_or_is_lost(busy: ListBus) -> None:
    run(busy, [frame(i) for i in range(FRAMES)])
    told = {m.keyframe: m.index for m in busy.of("tracked") if m.keyframe >= 0}
    assert told == {k.id: k.index for k in busy.of("keyframe")}
    assert {k.keyframe: k.index for k in busy.of("keyframe_image")} == told
    found = positions(busy)
    assert set(range(5, FRAMES)) <= found.keys()
    assert max(np.linalg.norm(found[i] - true_position(i)) for i in found) < 0.05


@pytest.fixture
def eager(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every frame that is judged becomes a keyframe."""
    monkeypatch.setattr(tracker, "decide", lambda *_: "eager")
    monkeypatch.setattr(tracker, "shown_before", lambda *_: None)


@pytest.mark.usefixtures("eager")
def test_frames_between_are_not_judged(busy: ListBus) -> None:
    run(busy, [frame(i) for i in range(30)])
    made = [k.index for k in busy.of("keyframe")][2:]  # the first two are a map's beginning
    assert np.diff(made).tolist() == [3] * (len(made) - 1)


@pytest.mark.usefixtures("eager")
def test_nor_later_where_nothing_is_seen_any_more(busy: ListBus) -> None:
    run(busy, [frame(i) for i in range(30)])
    last = busy.of("keyframe")[4].index
    dark = np.zeros_like(frame(0).image)

    bus = ListBus("frame")
    World(bus)
    bus.in_time = False
    run(bus, [frame(i) if i <= last + 2 else frame(i, image=dark) for i in range(last + 6)])
    assert [k.index for k in bus.of("keyframe")][-1] == last


def test_a_keyframe_says_how_far_the_camera_had_come_when_it_was_taken(busy: ListBus) -> None:
    run(busy, [frame(i) for i in range(FRAMES)])
    found = positions(busy)
    way = {0: 0.0}
    for i in range(1, FRAMES):
        before, now = found.get(i - 1), found.get(i)
        way[i] = way[i - 1] + (0.0 if before is None or now is None else float(np.linalg.norm(now - before)))
    first, *others = busy.of("keyframe")[1:]
    assert others
    for keyframe in others:
        gone = way[keyframe.index] - way[first.index]
        assert keyframe.travelled - first.travelled == pytest.approx(gone, abs=0.003)


def test_in_lockstep_they_wait(busy: ListBus) -> None:
    run(busy, [frame(i) for i in range(20)], LOCKSTEP)
    order = [(t, m.index) for t, m in busy.sent if t in ("keyframe", "tracked")]
    keyframes = busy.of("keyframe")
    assert keyframes
    for keyframe in keyframes:
        assert order.index(("keyframe", keyframe.index)) == order.index(("tracked", keyframe.index)) + 1
