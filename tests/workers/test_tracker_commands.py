"""Commands of the tracker: a new map, and a map that stays as it is."""

from __future__ import annotations

import itertools

import pytest

from prism_edge.tracking.tracker import Tracker
from tests.workers.list_bus import ListBus
from tests.workers.tracker_bench import frame, run


def when_frames_left(bus: ListBus, left: int, name: str, argument: str = "") -> None:
    """Ask for a command once so many frames are still to come."""
    served = bus.desk.before_serving
    asked = []

    def look() -> None:
        served()
        if not asked and len(bus.inboxes["frame"].waiting) == left:
            asked.append(name)
            bus.desk.ask(name, argument)

    bus.desk.before_serving = look


@pytest.mark.usefixtures("world")
def test_reset_begins_a_new_map_and_odom_goes_on(bus: ListBus) -> None:
    when_frames_left(bus, 20, "reset")
    run(bus, [frame(i) for i in range(60)])
    assert [reply.ok for reply in bus.desk.replies] == [True]
    keyframes = bus.of("keyframe")
    assert [k.epoch for k in keyframes] == sorted(k.epoch for k in keyframes)
    assert {k.epoch for k in keyframes} == {0, 1}
    assert [told.epoch for told in bus.of("new_map")] == [1]
    assert bus.forgotten == ["tf"], "who asks is not led into the map that is gone"
    assert len({k.id for k in keyframes}) == len(keyframes)
    # odom: no step between frames is larger across the reset than the camera's own motion
    steps = [m.pose.pose.position for m in bus.of("odom")]
    distances = [
        ((a.x - b.x) ** 2 + (a.y - b.y) ** 2 + (a.z - b.z) ** 2) ** 0.5
        for a, b in itertools.pairwise(steps)
    ]
    assert max(distances) < 0.1
    assert len(steps) > 45


@pytest.mark.usefixtures("world")
def test_localise_only_makes_no_keyframes_until_told_to(bus: ListBus) -> None:
    when_frames_left(bus, 40, "localise_only", "on")
    when_frames_left(bus, 10, "localise_only", "off")
    run(bus, [frame(i) for i in range(70)])
    assert [reply.ok for reply in bus.desk.replies] == [True, True]
    made = [m.keyframe for m in bus.of("tracked")]
    assert any(k >= 0 for k in made[:30])
    assert all(k < 0 for k in made[30:60])
    published = [m.published for m in bus.of("tracked")]
    assert all(published[30:45])  # the map that is there still carries the camera
    words = [m.status[0].message for m in bus.of("status")]
    assert any(word.endswith("localised") for word in words)
    assert words[-1].endswith("building")


@pytest.mark.usefixtures("world")
def test_a_part_that_waits_for_depth_is_given_up_where_nothing_more_is_mapped(
    bus: ListBus, monkeypatch: pytest.MonkeyPatch
) -> None:
    given_up: list[bool] = []
    monkeypatch.setattr(Tracker, "give_up_waiting", lambda tracker: given_up.append(tracker.may_map))
    when_frames_left(bus, 10, "localise_only", "on")
    run(bus, [frame(i) for i in range(30)])
    assert False in given_up


def test_there_must_be_a_map_to_localise_in(bus: ListBus) -> None:
    when_frames_left(bus, 1, "localise_only", "on")
    run(bus, [frame(0)])
    assert [(r.ok, r.said) for r in bus.desk.replies] == [(False, "there is no map to localise in yet")]


@pytest.mark.usefixtures("world")
@pytest.mark.parametrize(
    ("commands", "word", "keyframes"),
    [
        ([("localise_only", "on")], "ok localised", None),
        ([("localise_only", "on"), ("localise_only", "off")], "ok building", None),
        ([("reset", "")], "initialising building", 0),
        ([("localise_only", "on"), ("reset", "")], "initialising building", 0),
        ([("reset", ""), ("localise_only", "off")], "initialising building", 0),
    ],
)
def test_status_follows_a_command_without_another_image(
    bus: ListBus, commands: list[tuple[str, str]], word: str, keyframes: int | None
) -> None:
    """The source is paused, or its camera away."""
    for command in commands:
        when_frames_left(bus, 0, *command)
    run(bus, [frame(i) for i in range(30)])
    assert [reply.ok for reply in bus.desk.replies] == [True] * len(commands)
    last = bus.of("status")[-1].status[0]
    assert last.message == word
    shown = {pair.key: pair.value for pair in last.values}
    assert shown["map"] == bus.pulse.values["map"] == word.split()[1]
    assert (shown["keyframes"] == "0") == (keyframes == 0)


@pytest.mark.usefixtures("world")
def test_a_new_map_is_built_on_again(bus: ListBus) -> None:
    when_frames_left(bus, 50, "localise_only", "on")
    when_frames_left(bus, 40, "reset")
    run(bus, [frame(i) for i in range(70)])
    assert [reply.ok for reply in bus.desk.replies] == [True, True]
    assert "built on" in bus.desk.replies[1].said
    assert len([k for k in bus.of("keyframe") if k.epoch == 1]) >= 2
