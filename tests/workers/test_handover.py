"""An answer made in another thread than the asker's."""

from __future__ import annotations

import threading
import time
import weakref

from prism_edge.workers.handover import Handover
from tests.waiting import until


def test_the_serving_thread_makes_what_the_asking_one_gets() -> None:
    handover, makers = Handover(), []
    done = threading.Event()

    def serve() -> None:
        while not done.is_set():
            handover.serve(lambda: makers.append(threading.get_ident()) or len(makers))
            time.sleep(0.005)

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        assert [handover.ask(), handover.ask()] == [1, 2]
        assert set(makers) == {thread.ident}
    finally:
        done.set()
        thread.join()


def test_nothing_is_made_that_nobody_asked_for() -> None:
    Handover().serve(lambda: (_ for _ in ()).throw(AssertionError))


def test_a_worker_that_does_not_come_to_it_gives_nothing_and_nothing_stale_later() -> None:
    handover = Handover(patience_s=0.05)
    assert handover.ask() is None
    handover.serve(lambda: "stale")  # nobody waits any more
    assert handover.ask() is None


def test_what_is_being_made_is_wanted_no_more() -> None:
    handover, wanted = Handover(), []
    thread = threading.Thread(target=handover.ask)
    thread.start()
    until(lambda: handover.wanted)
    handover.serve(lambda: wanted.append(handover.wanted))
    thread.join()
    assert wanted == [False]


def test_what_nobody_waits_for_any_more_is_not_even_made() -> None:
    """It may take a worker seconds: a snapshot of a large map."""
    handover = Handover(patience_s=0.01)
    assert handover.ask() is None
    handover.serve(lambda: (_ for _ in ()).throw(AssertionError))


class Map:
    """Something large, which nobody should hold on to."""


def test_what_was_begun_for_an_asker_who_gave_up_is_not_the_next_ones() -> None:
    """A backend takes its time for a map, and the tracker asks again: for the map as it is then."""
    handover, made = Handover(patience_s=0.05), [Map(), Map()]
    first, second = map(weakref.ref, made)
    begun, go, done = threading.Event(), threading.Event(), threading.Event()

    def make() -> Map:
        begun.set()
        assert go.wait(30.0)
        return made.pop(0)

    def serve() -> None:
        while not done.is_set():
            handover.serve(make)
            time.sleep(0.001)

    answers: list[Map | None] = []
    worker = threading.Thread(target=serve)
    again = threading.Thread(target=lambda: answers.append(handover.ask()))
    worker.start()
    try:
        while not begun.is_set():
            assert handover.ask() is None
        handover._patience_s = 30.0
        again.start()
        until(lambda: handover.wanted)
        go.set()
        again.join()
        until(lambda: not made)
    finally:
        go.set()
        done.set()
        worker.join()
    assert answers[0] is not None
    assert answers.pop() is second()
    assert (first(), second()) == (None, None), "neither is kept"


def test_what_comes_too_late_is_not_kept() -> None:
    handover, (begun, go) = Handover(patience_s=0.05), (threading.Event(), threading.Event())
    late: list[weakref.ref[Map]] = []

    def make() -> Map:
        begun.set()
        assert go.wait(30.0)
        made = Map()
        late.append(weakref.ref(made))
        return made

    def serve() -> None:
        while not late:
            handover.serve(make)
            time.sleep(0.001)

    worker = threading.Thread(target=serve)
    worker.start()
    while not begun.is_set():
        assert handover.ask() is None
    go.set()
    worker.join()
    assert late[0]() is None


def test_no_answer_is_one_too_and_comes_at_once() -> None:
    handover, done = Handover(patience_s=60.0), threading.Event()

    def serve() -> None:
        while not done.is_set():
            handover.serve(lambda: None)
            time.sleep(0.001)

    worker = threading.Thread(target=serve)
    worker.start()
    try:
        began = time.monotonic()
        assert handover.ask() is None
        assert time.monotonic() - began < 50.0
    finally:
        done.set()
        worker.join()
