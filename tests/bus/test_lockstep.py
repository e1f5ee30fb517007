"""Who has done which frame."""

from __future__ import annotations

import threading

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from prism_edge.bus.lockstep import Gatekeeper, Ledger
from prism_edge.bus.session import Bus
from prism_edge.messages import Acknowledged
from tests.waiting import until


def test_everybody_is_missing_until_they_say_so():
    ledger = Ledger(["tracker", "depth"])
    assert ledger.missing(0) == {"tracker", "depth"}
    ledger.note(Acknowledged("depth", 0))
    assert ledger.missing(0) == {"tracker"}
    ledger.note(Acknowledged("tracker", 0))
    assert ledger.missing(0) == set()
    assert ledger.missing(1) == {"tracker", "depth"}


def test_a_later_frame_settles_the_earlier_ones():
    ledger = Ledger(["depth"])
    ledger.note(Acknowledged("depth", 7))
    ledger.note(Acknowledged("depth", 3))  # late
    assert ledger.missing(7) == set()


def test_those_who_are_not_part_of_the_run_do_not_count():
    ledger = Ledger(["tracker"])
    ledger.note(Acknowledged("depth", 5))
    assert ledger.missing(0) == {"tracker"}
    assert Ledger([]).missing(5) == set()


@settings(max_examples=100, deadline=None)
@given(st.lists(st.tuples(st.sampled_from("abc"), st.integers(-2, 20))), st.integers(0, 20))
def test_missing_are_those_who_never_named_this_frame_or_a_later_one(said, index):
    ledger = Ledger("abc")
    for process, done in said:
        ledger.note(Acknowledged(process, done))
    assert ledger.missing(index) == {p for p in "abc" if not any(q == p and i >= index for q, i in said)}


@pytest.fixture
def buses(config):
    with Bus.open(config, "source", listen=True) as source, Bus.open(config, "tracker") as tracker:
        yield source, tracker


def test_the_gate_opens_when_all_have_acknowledged(buses):
    source, tracker = buses
    gate = Gatekeeper(source, ["tracker", "depth"], patience_s=20.0)
    source.pulse.ready()
    assert tracker.await_ready(["source"], 10.0) == set()
    for name in ("tracker", "scale", "depth"):
        tracker.publish("acknowledged", Acknowledged(name, 4))
    assert gate.wait(4) == set()
    assert gate.wait(2) == set()


def test_patience_ends_and_names_who_is_missing(buses):
    source, tracker = buses
    gate = Gatekeeper(source, ["tracker", "depth"], patience_s=0.5)
    source.pulse.ready()
    assert tracker.await_ready(["source"], 30.0) == set()
    tracker.publish("acknowledged", Acknowledged("tracker", 0))
    until(lambda: gate._inbox._samples)  # the patience is for who says nothing, not for the link
    assert gate.wait(0) == {"depth"}


def test_a_stopped_bus_ends_the_wait(buses):
    source, _ = buses
    gate = Gatekeeper(source, ["depth"], patience_s=60.0)
    threading.Timer(0.05, source.stopped.set).start()
    assert gate.wait(0) == {"depth"}
