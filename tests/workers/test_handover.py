"""An answer made in another thread than the asker's."""

from __future__ import annotations

import threading
import time

from prism_edge.workers.handover import Handover


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


def test_what_nobody_waits_for_any_more_is_not_even_made() -> None:
    """It may take a worker seconds: a snapshot of a large map."""
    handover = Handover(patience_s=0.01)
    assert handover.ask() is None
    handover.serve(lambda: (_ for _ in ()).throw(AssertionError))
