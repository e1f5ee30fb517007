"""A thread without which a process is deaf or mute, and what its failure does to that process."""

from __future__ import annotations

import subprocess
import sys

import pytest

PROGRAM = """
import logging, os, sys, threading
from prism_edge.vital import vital
logging.basicConfig(stream=sys.stderr)
def fails(what):
    {raises}
thread = vital(fails, "inbox", ("a sample",))
thread.start()
{waits}
"""


# As where a limit is reached: from then on nothing can be allocated, by whomever.
STARVES = """
    main = threading.main_thread().ident
    while sys._current_frames()[main].f_code.co_name != "waits":
        pass
    __import__("time").sleep(0.1)
    __import__("_testcapi").set_nomemory(0)
    what + what
def waits(pipe):
    return os.read(pipe, 1)
"""


def ended(raises: str, waits: str = "threading.Event().wait(20.0)") -> subprocess.CompletedProcess[str]:
    program = PROGRAM.format(raises=raises.strip(), waits=waits)
    command = [sys.executable, "-c", program]
    return subprocess.run(command, capture_output=True, text=True, timeout=15.0)


@pytest.mark.parametrize("raises", ["raise MemoryError", "1 / 0", "raise KeyboardInterrupt(what)"])
def test_the_process_ends_at_once_and_says_why(raises: str) -> None:
    done = ended(raises)
    assert done.returncode == 70
    assert "the thread inbox failed" in done.stderr
    assert ("ZeroDivisionError" if "/" in raises else raises.split()[1].split("(")[0]) in done.stderr


def test_it_ends_where_not_even_that_can_be_said() -> None:
    done = ended("logging.Logger.exception = None; 1 / 0")
    assert done.returncode == 70


def test_it_ends_where_nothing_can_be_allocated_any_more() -> None:
    pytest.importorskip("_testcapi", reason="this interpreter comes without its own tests' module")
    done = ended(STARVES, "waits(os.pipe()[0])")
    assert done.returncode == 70
    assert "the thread inbox failed: MemoryError" in done.stderr


def test_one_array_that_is_too_large_is_told_of_with_its_lines() -> None:
    done = ended("import numpy; numpy.zeros(1 << 50)")
    assert done.returncode == 70
    assert "the thread inbox failed; please report it" in done.stderr
    assert "numpy.zeros(1 << 50)" in done.stderr or "line 6, in fails" in done.stderr


def test_it_ends_though_another_keeps_the_log_for_itself() -> None:
    hold = "threading.Thread(target=logging._lock.acquire, daemon=True).start()"
    hold += "; threading.Thread(target=logging.getLogger().handlers[0].acquire, daemon=True).start()"
    done = ended(f"{hold}; raise MemoryError")
    assert done.returncode == 70


def test_a_thread_that_has_done_its_work_ends_alone() -> None:
    done = ended("threading.Timer(0.1, __import__('os')._exit, (3,)).start()")
    assert done.returncode == 3
