"""A terminal that goes away ends an evaluation in order."""

from __future__ import annotations

import contextlib
import os
import signal
from collections.abc import Iterator

import pytest

from prism_edge.cli.eval import ended_in_order


def test_it_leaves_through_the_blocks_that_end_the_daemon() -> None:
    before = signal.getsignal(signal.SIGHUP)
    with pytest.raises(SystemExit) as ended, ended_in_order():
        os.kill(os.getpid(), signal.SIGHUP)
    assert ended.value.code == 128 + signal.SIGHUP
    assert signal.getsignal(signal.SIGHUP) == before


def test_under_nohup_it_goes_on() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with ended_in_order():
            os.kill(os.getpid(), signal.SIGHUP)
    finally:
        signal.signal(signal.SIGHUP, before)


def test_a_second_signal_breaks_nothing_off() -> None:
    """The shell and the kernel each send one as a terminal closes; timeout(1) sends two."""
    ended: list[str] = []

    @contextlib.contextmanager
    def daemon() -> Iterator[None]:
        try:
            yield
        finally:
            for number in (signal.SIGHUP, signal.SIGTERM):
                os.kill(os.getpid(), number)
            ended.append("whole")

    with pytest.raises(SystemExit) as first, ended_in_order(), daemon():
        os.kill(os.getpid(), signal.SIGHUP)
    assert first.value.code == 128 + signal.SIGHUP
    assert ended == ["whole"]
