"""When the backend looks for a rolling shutter, and what becomes of what it finds."""

from __future__ import annotations

import logging
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from prism_edge.backend.readout import Readout
from prism_edge.messages import EndOfStream
from prism_edge.workers import backend as worker
from prism_edge.workers import shutter_watch
from prism_edge.workers.shutter_watch import FIRST, LAST, MOST_AT_END, ShutterWatch
from tests.synthetic.messages import tick
from tests.workers.backend_bench import CONFIG, LOCKSTEP, depth_of, gate_of, hear, keyframes, scale_of
from tests.workers.list_bus import ListBus

NONE, SURE = Readout(1.0, 2.0, 20), Readout(0.1, 0.2, 60)
CLEAR, NEWS = Readout(25.2, 2.1, 19), Readout(3.5, 1.1, 40)


class Looks:
    """In the estimate's place: which maps it was asked of, by their size, and what it then says."""

    def __init__(self) -> None:
        self.at: list[int] = []
        self.says: Readout | None = NONE

    def __call__(self, world: Any) -> Readout | None:
        self.at.append(len(world.keyframes))
        return self.says


@pytest.fixture
def looks(monkeypatch: pytest.MonkeyPatch) -> Looks:
    looks = Looks()
    monkeypatch.setattr(shutter_watch, "readout_of", looks)
    return looks


@pytest.fixture
def taken(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """What is taken out."""
    taken: list[float] = []

    def take_out(world: Any, more_ms: float) -> None:
        taken.append(more_ms)
        world.readout_ms += more_ms

    monkeypatch.setattr(shutter_watch, "take_out", take_out)
    return taken


class Map:
    """A mapper's map of so many keyframes."""

    def __init__(self, cameras: str = "one") -> None:
        self.world = SimpleNamespace(keyframes={}, readout_ms=0.0, readout_said=False)
        self.cameras, self.epoch, self.overhauls = cameras, 0, 0
        self.loops = SimpleNamespace(overhaul=self._overhaul)
        self.bus = ListBus()
        self.watch = ShutterWatch(self, self.bus.pulse, True)  # type: ignore[arg-type]

    def _overhaul(self) -> None:
        self.overhauls += 1

    def look(self, count: int, ended: bool = False) -> bool | None:
        camera = {k: SimpleNamespace(camera=k if self.cameras == "many" else 0) for k in range(count)}
        self.world.keyframes = camera
        return self.watch.look(ended)


def test_it_looks_as_the_map_grows_and_at_its_end(looks):
    made = Map()
    looked = [count for count in range(60) if made.look(count) is not None]
    assert looks.at == looked == [15, 21, 30, 42, 59]
    assert made.look(59, ended=True) is None, "as large as it was when it was looked at"
    assert made.look(60, ended=True) is False
    assert made.look(LAST + 1, ended=True) is None, "it takes too long"
    assert made.bus.states == ["rolling shutter"] * 6, "the supervisor knows what it waits for"
    assert "warning" not in made.bus.pulse.values


@pytest.mark.parametrize("why", ["said", "known", "many"])
def test_it_looks_more_seldom_where_that_is_enough(looks, why):
    made, looks.says = Map(why), SURE if why == "known" else NONE
    made.world.readout_said = why == "said"
    assert [count for count in range(61) if made.look(count) is not None] == [15, 30, 60]


def test_what_is_clear_is_taken_out_and_the_map_adjusted_to_that(looks, taken, caplog):
    made = Map()
    with caplog.at_level(logging.INFO, "prism_edge.backend"):
        assert made.look(FIRST) is False
        assert "none for sure" in caplog.messages[-1]
        looks.says = None
        assert made.look(2 * FIRST) is False
        looks.says = NEWS
        assert made.look(3 * FIRST) is False, "no news of what is none"
        looks.says = CLEAR
        assert made.look(5 * FIRST) is True
        assert caplog.messages[-1].startswith("rolling shutter: rows are read over 25.2 ms longer")
        assert "taken out" in caplog.messages[-1]
    assert (taken, made.overhauls, made.bus.pulse.values) == ([25.2], 1, {})
    looks.says = NEWS
    assert made.look(9 * FIRST) is True
    looks.says = NONE
    assert made.look(20 * FIRST) is False
    assert taken == [25.2, 3.5]
    made.epoch, looks.says = 1, CLEAR
    assert made.look(FIRST) is True, "another map"


def test_at_the_end_what_is_taken_out_is_looked_at_again_but_not_for_ever(looks, taken):
    made, looks.says = Map(), CLEAR
    assert [made.look(FIRST - 1, ended=True) for _ in range(MOST_AT_END + 1)] == [True] * MOST_AT_END + [None]
    assert len(taken) == made.overhauls == MOST_AT_END


@pytest.mark.parametrize("why", ["said", "off", "many"])
def test_what_can_not_be_taken_out_is_said_once_on_the_log_and_stays_on_health(looks, taken, caplog, why):
    made, looks.says = Map(why), CLEAR
    made.world.readout_said = why == "said"
    if why == "off":
        made.watch = ShutterWatch(made, made.bus.pulse, False)
    assert made.look(FIRST) is False
    (warning,) = caplog.messages
    assert "25.2 ms longer than is known, sigma 2.1, 19 keyframes: tell readout_ms" in warning
    assert made.bus.pulse.values["warning"] == warning
    assert made.look(8 * FIRST, ended=True) is None, "it is sure"
    made.epoch, looks.says = 1, Readout(-25.0, 2.0, 19)
    assert made.look(FIRST) is False, "another map"
    assert "25.0 ms shorter than is known" in made.bus.pulse.values["warning"]
    made.epoch = 2
    made.look(1)
    assert "warning" not in made.bus.pulse.values
    assert (taken, made.overhauls) == ([], 0)


@pytest.mark.usefixtures("impatient")
@pytest.mark.parametrize("first", [3, FIRST])
def test_the_backend_has_its_map_looked_at_between_keyframes_or_at_the_end(looks, monkeypatch, first):
    monkeypatch.setattr(shutter_watch, "FIRST", first)
    bus, (teller, told) = ListBus("keyframe", patience=40), keyframes(3)
    bus.give("depth", *(depth_of(k, teller) for k in told))
    bus.give("keyframe", *told)
    bus.give("end", EndOfStream(100, 100, 0, 0, 99))
    worker.main(CONFIG, bus)
    assert looks.at == [3]
    then = bus.states[bus.states.index("rolling shutter") + 1]
    assert then == ("idle" if first == 3 else "ended"), "else the supervisor thinks that it hangs"


@pytest.mark.usefixtures("impatient")
@pytest.mark.parametrize("first", [3, FIRST])
def test_the_tracker_is_told_of_what_was_taken_out_and_the_map_is_adjusted(monkeypatch, first):
    monkeypatch.setattr(shutter_watch, "FIRST", first)
    bus, (teller, told) = ListBus("keyframe", patience=40), keyframes(3)
    sent: list[int] = []

    def found(world: Any) -> Readout:
        sent.append(len(bus.sent))
        return CLEAR

    monkeypatch.setattr(shutter_watch, "readout_of", found)
    told = [replace(keyframe, twist=np.array([0.2, 0.0, 0.0, 0.0, 0.3, 0.0])) for keyframe in told]
    bus.give("depth", *(depth_of(k, teller) for k in told))
    bus.give("keyframe", *told)
    bus.give("end", EndOfStream(100, 100, 0, 0, 99))
    worker.main(CONFIG, bus)
    topic, update = bus.sent[sent[0]]
    assert topic == "map_update", "before an adjustment, which may fail"
    assert update.everything
    assert update.readout_ms == pytest.approx(25.2)
    later = bus.sent[sent[0] + 1 :]
    assert all(m.readout_ms >= 25.2 for t, m in later if t == "map_update")
    assert any(m.everything for t, m in later if t == "solved"), "its points were seen elsewhere"
    assert bus.states[-1] == "ended"


def test_in_lockstep_a_map_is_looked_at_with_its_keyframes(looks, monkeypatch):
    """Whenever the worker has time for it: two runs are to be the same."""
    monkeypatch.setattr(shutter_watch, "FIRST", 2)
    looks.says = CLEAR
    bus, (teller, told) = ListBus("tracked"), keyframes(4)
    for keyframe in told:
        bus.give("keyframe", keyframe)
        bus.give("depth", depth_of(keyframe, teller))
        bus.give("log_scale", scale_of(keyframe))
        bus.give("gate", gate_of(keyframe))
    bus.give("tracked", *(tick(i, i) for i in range(4)))
    worker.main(LOCKSTEP, bus)
    updates = bus.of("map_update")
    assert [u.based_on for u in updates] == [0, 1, 2, 3], "one a keyframe, as the tracker waits for them"
    assert [round(u.readout_ms, 1) for u in updates] == [0.0, 25.2, 50.4, 50.4]
    assert [u.everything for u in updates][1:3] == [True, True]
    assert looks.at == [2, 3]


def test_who_is_to_stop_does_not_begin_to_look(looks):
    bus, (teller, told) = ListBus(), keyframes(3)
    made = worker.BackendWorker(CONFIG, bus)
    hear(made, bus, told, teller)
    bus.stopped.set()
    made._settle()
    assert looks.at == []
    bus.stopped.clear()
    made._settle()
    assert looks.at == [3]
