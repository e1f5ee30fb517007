"""Keyframes wait for what belongs to them, in any order, and no longer than that."""

from __future__ import annotations

import itertools
from dataclasses import replace

import pytest

from prism_edge.messages import Keyframe
from prism_edge.workers import arrivals
from prism_edge.workers import backend as worker
from prism_edge.workers.arrivals import Arrivals
from tests.workers.backend_bench import CONFIG, depth_of, gate_of, hear, keyframes
from tests.workers.list_bus import ListBus

ALL = {"depth", "scale"}
TELLER, TOLD = keyframes(4)


@pytest.fixture(autouse=True)
def for_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(arrivals, "DEPTH_WAIT_S", 1e6)


def give(to: Arrivals, what: str, keyframe: Keyframe) -> None:
    if what == "keyframe":
        to.keyframe(keyframe)
    elif what == "depth":
        to.depth(depth_of(keyframe, TELLER))
    elif what == "gate":
        to.gate(gate_of(keyframe))
    else:
        to.scale(keyframe.id)


@pytest.mark.parametrize("order", list(itertools.permutations(("keyframe", "depth", "gate", "scale"))))
def test_a_keyframe_is_complete_with_the_last_of_its_messages(order: tuple[str, ...]) -> None:
    waits = Arrivals(ALL, use_depth=True)
    for k, what in enumerate(order):
        assert not waits.complete(0)
        has = set(order[:k])
        if not has >= {"keyframe", "depth", "gate"}:
            assert waits.next(patient=True) is None
        assert len(waits) == ("keyframe" in has)
        give(waits, what, TOLD[0])
    assert waits.complete(0)
    assert waits.next(patient=True) is TOLD[0]
    depth, gate = waits.take(0)
    assert (depth is not None and depth.keyframe, gate is not None and gate.keyframe) == (0, 0)
    assert waits.take(0) == (None, None)


@pytest.mark.parametrize("peers", [set(), {"depth"}, {"scale"}])
def test_nothing_is_awaited_from_processes_that_there_are_not(peers: set[str]) -> None:
    waits = Arrivals(peers, use_depth=False)
    waits.keyframe(TOLD[0])
    assert waits.complete(0) == (not peers)
    if "depth" in peers:
        give(waits, "depth", TOLD[0])
    if "scale" in peers:
        give(waits, "gate", TOLD[0])
        give(waits, "scale", TOLD[0])
    assert waits.complete(0)
    assert waits.next(patient=True) is TOLD[0], "depth that is not used is not waited for"


def test_they_join_in_their_order_and_none_overtakes(monkeypatch: pytest.MonkeyPatch) -> None:
    waits = Arrivals(ALL, use_depth=True)
    for keyframe in TOLD[:3]:
        waits.keyframe(keyframe)
    give(waits, "depth", TOLD[1])
    give(waits, "gate", TOLD[1])
    assert waits.next(patient=True) is None, "the first has nothing yet"
    assert waits.until(-1) is None
    assert waits.until(0) is TOLD[0]
    assert waits.next(patient=True) is TOLD[1]
    monkeypatch.setattr(arrivals, "DEPTH_WAIT_S", 0.0)
    assert waits.next(patient=True) is TOLD[2], "it has waited long enough"
    assert (waits.next(patient=True), waits.next(patient=False), waits.until(9)) == (None, None, None)


def test_of_a_map_that_is_gone_nothing_is_awaited() -> None:
    waits = Arrivals(ALL, use_depth=True)
    for k in (1, 0):
        waits.is_gone(TOLD[k])
    assert [waits.complete(k) for k in range(3)] == [True, True, False]
    waits.keyframe(TOLD[2])
    waits.keyframe(replace(TOLD[3], epoch=5))
    waits.begin(5)
    assert len(waits) == 1, "a new map's own waits on"
    assert not waits.complete(2)
    waits.give_up()
    assert len(waits) == 0
    assert waits.complete(3)


def test_what_came_of_older_keyframes_is_forgotten() -> None:
    waits = Arrivals(ALL, use_depth=True)
    for keyframe in TOLD:
        for what in ("keyframe", "depth", "gate", "scale"):
            give(waits, what, keyframe)
    waits.take(2)
    assert [waits.complete(k) for k in range(4)] == [False, False, False, True]
    assert [waits.take(k) for k in range(3)] == [(None, None)] * 3


def test_what_is_kept_for_later_does_not_grow() -> None:
    """Weeks of keyframes: depths that came early and scales are forgotten once their turn is over."""
    teller, told = keyframes(12)
    bus = ListBus("keyframe")
    made = worker.BackendWorker(CONFIG, bus)
    hear(made, bus, told, teller)
    kept = made._arrivals
    assert max(map(len, (kept._depths, kept._scales, kept._gates))) <= 1
    assert len(kept) == 0
