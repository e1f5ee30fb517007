"""Taking what has arrived."""

from __future__ import annotations

import queue
import threading
import time

import pytest
import zenoh

from prism_edge.bus.inbox import Inbox
from tests.waiting import until


class Subscriber:
    """Stands for Zenoh's: a channel that ``put`` fills."""

    def __init__(self):
        self.channel, self.handler = queue.SimpleQueue(), self

    def put(self, *samples):
        for sample in samples:
            self.channel.put(sample)

    def recv(self):
        sample = self.channel.get()
        if sample is None:
            raise zenoh.ZError("closed")
        return sample

    def undeclare(self):
        self.channel.put(None)


@pytest.fixture
def stopped():
    return threading.Event()


@pytest.fixture
def open_inbox(stopped):
    opened = []

    def make(capacity, unpack=lambda sample: sample, overflowed=None, arrived=None):
        subscriber = Subscriber()
        inbox = Inbox(subscriber, capacity, unpack, stopped, overflowed, arrived)
        opened.append(inbox)
        return subscriber, inbox

    yield make
    for inbox in opened:
        inbox.close()
        assert not inbox._thread.is_alive()


def has_arrived(inbox, count):
    return lambda: len(inbox._samples) == count


def test_a_queue_gives_everything_in_order(open_inbox):
    subscriber, inbox = open_inbox(10)
    subscriber.put("a", "b", "c")
    assert [inbox.take(5.0) for _ in range(3)] == ["a", "b", "c"]
    assert inbox.take() is None


def test_the_newest_wins_where_there_is_room_for_one(open_inbox):
    subscriber, inbox = open_inbox(1)
    subscriber.put("a", "b", "c")
    until(subscriber.channel.empty)
    until(lambda: inbox._samples and inbox._samples[-1] == "c")
    assert inbox.take() == "c"
    assert inbox.take() is None


def test_a_full_queue_loses_the_oldest_and_says_so(open_inbox):
    lost = []
    subscriber, inbox = open_inbox(2, overflowed=lambda: lost.append(1))
    subscriber.put("a", "b", "c")
    until(lambda: lost)
    assert inbox.drain() == ["b", "c"]


def test_a_queue_with_room_says_nothing_of_losses(open_inbox):
    lost, arrived = [], []
    subscriber, inbox = open_inbox(2, overflowed=lambda: lost.append(1), arrived=lambda: arrived.append(1))
    subscriber.put("a", "b")
    until(lambda: len(arrived) == 2)  # said last of each
    assert not lost
    assert inbox.drain() == ["a", "b"]


def test_when_a_message_arrived_is_known_whenever_it_is_taken(open_inbox):
    subscriber, inbox = open_inbox(2)
    subscriber.put("a", "b")
    until(has_arrived(inbox, 2))
    then = time.monotonic_ns()
    subscriber.put("c")
    until(lambda: "c" in inbox._samples)
    now = time.monotonic_ns()
    assert inbox.take() == "b"
    assert 0 < inbox.arrived_ns <= then
    assert inbox.take() == "c"
    assert then <= inbox.arrived_ns <= now


def test_what_was_drained_does_not_say_when_the_next_arrived(open_inbox):
    subscriber, inbox = open_inbox(10)
    subscriber.put("a", "b")
    until(has_arrived(inbox, 2))
    inbox.drain()
    then = time.monotonic_ns()
    subscriber.put("c")
    assert inbox.take(5.0) == "c"
    assert inbox.arrived_ns >= then


def test_drain_takes_all(open_inbox):
    subscriber, inbox = open_inbox(10)
    subscriber.put("a", "b")
    until(has_arrived(inbox, 2))
    assert inbox.drain() == ["a", "b"]
    assert inbox.drain() == []


def test_malformed_messages_are_passed_over(open_inbox):
    subscriber, inbox = open_inbox(10, unpack=lambda sample: None if sample == "bad" else sample)
    subscriber.put("bad", "a", "bad", "b", "bad")
    assert inbox.take(5.0) == "a"
    until(has_arrived(inbox, 3))
    assert inbox.drain() == ["b"]


def test_taking_waits_for_an_arrival(open_inbox):
    subscriber, inbox = open_inbox(1)
    threading.Timer(0.05, subscriber.put, ["late"]).start()
    assert inbox.take(10.0) == "late"


def test_nothing_in_time_is_none(open_inbox):
    _, inbox = open_inbox(1)
    start = time.monotonic()
    assert inbox.take(0.05) is None
    assert time.monotonic() - start >= 0.05


def test_a_stopped_bus_ends_the_wait(open_inbox, stopped):
    _, inbox = open_inbox(1)
    threading.Timer(0.05, stopped.set).start()
    start = time.monotonic()
    assert inbox.take(60.0) is None
    assert time.monotonic() - start < 30.0


def test_a_stopped_bus_gives_nothing_more(open_inbox, stopped):
    subscriber, inbox = open_inbox(1)
    subscriber.put("a")
    until(has_arrived(inbox, 1))
    stopped.set()
    assert inbox.take(1.0) is None
    assert inbox.drain() == ["a"]


def test_what_arrives_elsewhere_ends_a_wait_once(open_inbox):
    _, waited_for = open_inbox(1)
    elsewhere, other = open_inbox(10, arrived=waited_for.rouse)
    threading.Timer(0.05, elsewhere.put, ["a"]).start()
    start = time.monotonic()
    assert waited_for.take(60.0) is None
    assert time.monotonic() - start < 30.0
    until(has_arrived(other, 1))
    start = time.monotonic()
    assert waited_for.take(0.05) is None  # not again for the same
    assert time.monotonic() - start >= 0.05


def test_a_message_comes_before_being_roused(open_inbox):
    subscriber, inbox = open_inbox(1)
    subscriber.put("a")
    until(has_arrived(inbox, 1))
    inbox.rouse()
    assert inbox.take(5.0) == "a"
    start = time.monotonic()
    assert inbox.take(0.05) is None  # it was roused before it last returned
    assert time.monotonic() - start >= 0.05
