"""What becomes of a bus that can't be left in time, and of the process it belonged to."""

from __future__ import annotations

import _thread
import os
import threading
from collections.abc import Callable, Iterator

import pytest

from prism_edge.bus import leaving
from prism_edge.bus.leaving import ended, leave


@pytest.fixture
def stuck(monkeypatch: pytest.MonkeyPatch) -> Iterator[threading.Event]:
    """Set: whoever hung reads on, and all that waits for him is done."""
    monkeypatch.setattr(leaving, "_unfinished", [])
    reads = threading.Event()
    yield reads
    reads.set()


def test_a_process_whose_bus_is_still_being_left_ends_on_the_spot(
    stuck: threading.Event, monkeypatch: pytest.MonkeyPatch
) -> None:
    codes: list[int] = []
    monkeypatch.setattr(os, "_exit", codes.append)
    leave(lambda: None, 60.0)
    assert ended(3) == 3
    assert codes == []
    leave(lambda: stuck.wait(60.0), 0.01)
    ended(4)
    assert codes == [4]


def test_what_was_left_late_is_left(stuck: threading.Event, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "_exit", lambda code: pytest.fail("nothing is left to be done"))
    leave(lambda: stuck.wait(60.0), 0.01)
    stuck.set()
    for left in leaving._unfinished:
        assert left.wait(60.0)
    assert ended(0) == 0


def test_where_no_thread_can_begin_any_more_it_is_left_all_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    """As at Python's end, from 3.12 on, where a script has not closed its bus."""

    def refused(run: Callable[[], None], arguments: tuple[()]) -> None:
        raise RuntimeError("can't create new thread at interpreter shutdown")

    monkeypatch.setattr(_thread, "start_new_thread", refused)
    done: list[str] = []
    leave(lambda: done.append("closed"), 1.0)
    assert done == ["closed"]


def test_a_thread_that_finds_no_memory_to_begin_with_is_not_waited_for(
    stuck: threading.Event, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The process is short of it, and is to end and to be started again."""
    codes: list[int] = []
    monkeypatch.setattr(os, "_exit", codes.append)
    monkeypatch.setattr(_thread, "start_new_thread", lambda run, arguments: 1)
    leave(lambda: None, 0.01)
    ended(70)
    assert codes == [70]
