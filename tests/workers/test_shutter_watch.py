"""When the backend looks for a rolling shutter, and what it says of one."""

from __future__ import annotations

import logging
from types import SimpleNamespace
from typing import Any

import pytest

from prism_edge.backend.readout import Readout
from prism_edge.messages import EndOfStream
from prism_edge.workers import backend as worker
from prism_edge.workers import shutter_watch
from prism_edge.workers.shutter_watch import FIRST, LAST, ShutterWatch
from tests.workers.backend_bench import CONFIG, depth_of, keyframes
from tests.workers.list_bus import ListBus

NONE = Readout(1.0, 2.0, 20)
CLEAR = Readout(25.2, 2.1, 19)


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


def of(count: int) -> Any:
    return SimpleNamespace(keyframes=dict.fromkeys(range(count)))


def test_it_looks_as_the_map_doubles_and_at_its_end(looks):
    bus = ListBus()
    watch = ShutterWatch(bus.pulse)
    looked = [count for count in range(3 * FIRST) if watch.look(of(count), 0)]
    assert looks.at == looked == [FIRST, 2 * FIRST]
    assert not watch.look(of(2 * FIRST), 0, ended=True), "as large as it was when it was looked at"
    assert watch.look(of(3 * FIRST - 1), 0, ended=True)
    assert not watch.look(of(LAST + 1), 0, ended=True), "it takes too long"
    assert bus.states == ["rolling shutter"] * 3, "the supervisor knows what it waits for"
    assert "warning" not in bus.pulse.values


def test_what_is_clear_is_said_once_on_the_log_and_stays_on_health(looks, caplog):
    bus = ListBus()
    watch = ShutterWatch(bus.pulse)
    with caplog.at_level(logging.INFO, "prism_edge.backend"):
        watch.look(of(FIRST), 0)
        assert "none for sure" in caplog.messages[-1]
        looks.says = None
        watch.look(of(2 * FIRST), 0)
        assert len(caplog.messages) == 1
        looks.says = CLEAR
        assert watch.look(of(4 * FIRST), 0)
    (warning,) = (r.getMessage() for r in caplog.records if r.levelno == logging.WARNING)
    assert "25.2 ms longer than is said, sigma 2.1, 19 keyframes: tell readout_ms" in warning
    assert bus.pulse.values["warning"] == warning
    assert not watch.look(of(8 * FIRST), 0, ended=True), "it is sure"
    looks.says = Readout(-25.0, 2.0, 19)
    assert watch.look(of(FIRST), 1), "another map"
    assert "25.0 ms shorter than is said" in bus.pulse.values["warning"]
    watch.look(of(1), 2)
    assert "warning" not in bus.pulse.values


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
