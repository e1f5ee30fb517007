"""A thread without which a process is deaf or mute, and what its failure does to that process."""

from __future__ import annotations

import subprocess
import sys

import pytest

PROGRAM = """
import logging, sys, threading
from prism_edge.vital import vital
logging.basicConfig(stream=sys.stderr)
def fails(what):
    {raises}
thread = vital(fails, "inbox", ("a sample",))
thread.start()
threading.Event().wait(20.0)
"""


def ended(raises: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", PROGRAM.format(raises=raises)]
    return subprocess.run(command, capture_output=True, text=True, timeout=15.0)


@pytest.mark.parametrize("raises", ["raise MemoryError", "1 / 0", "raise KeyboardInterrupt(what)"])
def test_the_process_ends_at_once_and_says_why(raises: str) -> None:
    done = ended(raises)
    assert done.returncode == 70
    assert "the thread inbox failed" in done.stderr
    assert ("ZeroDivisionError" if "/" in raises else raises.split()[1].split("(")[0]) in done.stderr


def test_it_ends_where_not_even_that_can_be_said() -> None:
    done = ended("logging.Logger.exception = None; raise MemoryError")
    assert done.returncode == 70


def test_a_thread_that_has_done_its_work_ends_alone() -> None:
    done = ended("threading.Timer(0.1, __import__('os')._exit, (3,)).start()")
    assert done.returncode == 3
