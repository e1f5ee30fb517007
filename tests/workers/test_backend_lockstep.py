"""The backend worker in lockstep: every frame is acknowledged, once what it waits for has come."""

from __future__ import annotations

from dataclasses import replace
from itertools import count
from types import SimpleNamespace

import numpy as np
import pytest

from prism_edge.config import StateConfig, TrackingConfig
from prism_edge.messages import Acknowledged, Epoch, Keyframe
from prism_edge.workers import backend as worker
from tests.backend.world import Teller
from tests.synthetic.messages import tick
from tests.workers.backend_bench import LOCKSTEP, NO_DEPTH, depth_of, gate_of, keyframes, live, scale_of
from tests.workers.list_bus import ListBus


@pytest.fixture(autouse=True)
def looks(monkeypatch):
    """Time goes by with looks at it, a hundredth of a second each: patience ends after ten thousand."""
    clock = count(0.0, 0.01)
    own = {"monotonic": lambda: next(clock), "monotonic_ns": lambda: round(next(clock) * 1e9)}
    monkeypatch.setattr(worker, "time", SimpleNamespace(**own, process_time=lambda: 0.0))
    monkeypatch.setattr(worker, "_PATIENCE_S", 100.0)


def lockstep(bus: ListBus, told: list[Keyframe], teller: Teller, with_scale: bool = True) -> None:
    """Four frames a keyframe, everything sent before the worker looks."""
    for keyframe in told:
        bus.give("keyframe", keyframe)
        bus.give("depth", depth_of(keyframe, teller))
        if with_scale:
            bus.give("log_scale", scale_of(keyframe))
            bus.give("gate", gate_of(keyframe))
    bus.give("tracked", *(tick(i, i // 4 if i % 4 == 0 else -1) for i in range(4 * len(told))))


def test_lockstep_acknowledges_every_frame_once_its_update_is_out(caplog):
    bus, (teller, told) = ListBus("tracked"), keyframes(4)
    lockstep(bus, told, teller)
    worker.main(LOCKSTEP, bus)
    assert "incomplete" not in caplog.text
    assert bus.of("acknowledged") == [Acknowledged("backend", i) for i in range(16)]
    sent = [(t, m) for t, m in bus.sent if t != "solved"]  # reports, which nobody waits for
    order = [(t, m.based_on if t == "map_update" else m.index) for t, m in sent]
    for k in range(4):
        assert order.index(("map_update", k)) == order.index(("acknowledged", 4 * k)) - 1


def test_lockstep_answers_each_keyframe_even_with_nothing():
    """The tracker waits for one update a keyframe, in the order of the keyframes."""
    bus, (teller, told) = ListBus("tracked"), keyframes(4)
    lockstep(bus, told, teller)
    worker.main(LOCKSTEP, bus)
    updates = bus.of("map_update")
    assert [u.based_on for u in updates] == [0, 1, 2, 3]
    assert [u.sequence for u in updates] == [1, 2, 3, 4]
    assert len(updates[0].keyframes) == 0
    assert all(len(u.keyframes) for u in updates[1:])


def test_lockstep_waits_for_keyframe_depth_scale_and_gate(caplog):
    """They come late, one at a time; the acknowledgement comes after the last of them."""
    teller, told = keyframes(2)
    bus = ListBus("tracked", patience=200)
    bus.give("tracked", tick(0, 0), tick(1, 1))
    late = {
        2: ("keyframe", told[0]),
        4: ("depth", depth_of(told[0], teller)),
        6: ("log_scale", scale_of(told[0])),
        8: ("gate", gate_of(told[0])),
    }
    made = worker.BackendWorker(LOCKSTEP, bus)
    looks = 0
    receive = made._receive

    def late_ones(timeout_s):
        nonlocal looks
        looks += 1
        if looks in late:
            assert not bus.of("acknowledged")
            bus.give(*late[looks])
        if looks == 9:
            bus.give("keyframe", told[1])
            bus.give("depth", depth_of(told[1], teller))
            bus.give("log_scale", scale_of(told[1]))
            bus.give("gate", gate_of(told[1]))
        receive(timeout_s)

    made._receive = late_ones
    made.run()
    assert looks >= 9
    assert "incomplete" not in caplog.text
    assert [a.index for a in bus.of("acknowledged")] == [0, 1]
    assert made._mapper.world.keyframes[0].depths is not None


def test_lockstep_goes_on_without_what_never_comes(monkeypatch, caplog):
    monkeypatch.setattr(worker, "_PATIENCE_S", 0.2)
    teller, told = keyframes(3)
    bus = ListBus("tracked", patience=100)
    lockstep(bus, told, teller, with_scale=False)
    worker.main(LOCKSTEP, bus)
    assert [a.index for a in bus.of("acknowledged")] == list(range(12))
    assert [u.based_on for u in bus.of("map_update")] == [0, 1, 2]
    assert "keyframe 0 is incomplete" in caplog.text


def test_lockstep_needs_no_depth_where_there_is_no_network(caplog):
    """A scale process is there all the same: a loaded map has metres."""
    _, told = keyframes(3)
    bus = ListBus("tracked")
    bus.give("keyframe", *told)
    bus.give("log_scale", *(scale_of(keyframe) for keyframe in told))
    bus.give("gate", *(gate_of(keyframe) for keyframe in told))
    bus.give("tracked", *(tick(i, i) for i in range(3)))
    worker.main(replace(NO_DEPTH, mode="lockstep"), bus)
    assert "incomplete" not in caplog.text
    assert [u.based_on for u in bus.of("map_update")] == [0, 1, 2]
    assert len(bus.of("acknowledged")) == 3


def test_lockstep_twice_is_the_same_to_the_last_bit():
    runs = []
    for _ in range(2):
        bus, (teller, told) = ListBus("tracked"), keyframes(5)
        lockstep(bus, told, teller)
        worker.main(LOCKSTEP, bus)
        runs.append(bus.of("map_update"))
    for first, second in zip(*runs, strict=True):
        assert np.array_equal(first.poses, second.poses)
        assert np.array_equal(first.positions, second.positions)


def test_a_reset_amid_a_keyframe_waits_until_that_is_done(caplog):
    """It would never be complete: all would wait for it until patience ends."""
    bus, (teller, told) = ListBus("tracked"), keyframes(2)
    lockstep(bus, told, teller)
    bus.give("new_map", Epoch(1))
    made = worker.BackendWorker(LOCKSTEP, bus)
    made.run()
    assert "incomplete" not in caplog.text
    assert [m.index for m in bus.of("acknowledged")] == list(range(8))
    assert [u.based_on for u in bus.of("map_update")] == [0, 1]
    assert made._mapper.epoch == 1


def test_a_keyframe_that_never_came_is_no_hang_afterwards(monkeypatch):
    """The source still waits for the tracker, so no tick comes, and the wait would be held against it."""
    monkeypatch.setattr(worker, "_PATIENCE_S", 0.05)
    bus = ListBus("tracked", patience=100)
    bus.give("tracked", tick(0, 0))
    worker.main(replace(NO_DEPTH, mode="lockstep"), bus)
    assert bus.of("acknowledged")
    waits = [i for i, state in enumerate(bus.states) if "waiting for keyframe 0" in state]
    assert bus.states[waits[-1] + 1 :][:1] in (["idle"], ["ended"])


@pytest.mark.parametrize("already_here", [False, True])
def test_a_keyframe_of_the_map_before_a_loaded_one_is_not_waited_for(already_here, tmp_path, caplog):
    """The frame that was under way when the command came: who asks for the loaded map would wait, too."""
    state = StateConfig(directory=str(tmp_path / "state"), journal=False)
    config = replace(LOCKSTEP, state=state, tracking=TrackingConfig(levels=8, scale_factor=1.2))
    teller, told = keyframes(5)
    live(tmp_path, told[:4], teller, config=replace(config, mode="realtime"), ask=("lab",))
    bus = ListBus("tracked", patience=200)
    made = worker.BackendWorker(config, bus)
    if already_here:
        bus.give("keyframe", told[4])
        made._receive(0.0)
    bus.desk.ask("load_map", "lab")
    made._desk.serve()
    assert bus.desk.replies[0].ok
    bus.give("tracked", tick(4, 4))
    if not already_here:
        bus.give("keyframe", told[4])
    made.run()
    assert "incomplete" not in caplog.text
    assert bus.of("acknowledged") == [Acknowledged("backend", 4)]
    assert sorted(made._mapper.world.keyframes) == [0, 1, 2, 3]
