"""A backend started by hand whose clock is behind that of its last life is told of."""

from __future__ import annotations

from dataclasses import replace

import pytest

from prism_edge.workers import clock_behind
from prism_edge.workers.clock_behind import OVERTAKEN, SURE, ClockBehind
from tests.workers.list_bus import ListBus
from tests.workers.tracker_bench import CONFIG, World, frame, run, update_of

LATEST = 10**15


def said(*ahead: int) -> bool:
    pulse = ListBus().pulse
    clock = ClockBehind(pulse)
    for number in ahead:
        clock.saw(number)
    return "warning" in pulse.values


def test_one_that_is_behind_for_long_is_said_once(caplog: pytest.LogCaptureFixture) -> None:
    assert said(1, *SURE * [-2 * OVERTAKEN], -2 * OVERTAKEN)
    assert caplog.text.count("clock is behind") == 1


def test_what_was_overtaken_or_late_is_nothing_to_speak_of() -> None:
    assert not said(*range(-9, 0))
    assert not said(*9 * [*(SURE - 1) * [-2 * OVERTAKEN], 1])


def test_the_tracker_looks(
    bus: ListBus, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(clock_behind, "SURE", 1)
    world = World(bus)
    numbers = iter([LATEST, LATEST - 600 * OVERTAKEN, *range(LATEST + 1, LATEST + 99)])
    world.update = lambda keyframe, sequence: update_of(
        keyframe, next(numbers), keyframe.world_from_camera[None]
    )
    run(bus, [frame(i) for i in range(30)], replace(CONFIG, mode="realtime"))
    assert caplog.text.count("clock is behind") == 1
