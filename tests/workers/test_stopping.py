"""SIGTERM and SIGINT reach a worker whatever its main thread is doing."""

from __future__ import annotations

import contextlib
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from prism_edge.workers.stopping import AGAIN_S

CHECKOUT = Path(__file__).resolve().parents[2]
DEADLINE_S = 30.0

SETUP = (
    "import re, threading\n"
    "from prism_edge.workers.stopping import StopSignals\n"
    "signals = StopSignals(); signals.listen(); other = threading.Event(); signals.also(other)\n"
    "print('up', flush=True)\n"
)
WAITS = SETUP + "assert other.wait(60)\nassert signals.stopped.is_set()\nprint('stopped', flush=True)\n"
# Native code that no signal brings back: a mutex locked twice. Other threads run on.
STUCK = SETUP + (
    "import ctypes; libc = ctypes.CDLL(None); mutex = ctypes.create_string_buffer(128)\n"
    "libc.pthread_mutex_lock(mutex); libc.pthread_mutex_lock(mutex)\n"
)
DEAF = SETUP + "import time\nwhile True: time.sleep(1)\n"


@pytest.fixture
def start() -> Iterator[Callable[[str], subprocess.Popen[str]]]:
    started = []

    def start(script: str) -> subprocess.Popen[str]:
        command = [sys.executable, "-c", script]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=CHECKOUT)
        started.append(process)
        assert process.stdout is not None
        assert process.stdout.readline() == "up\n"
        return process

    yield start
    for process in started:
        process.kill()
        process.communicate()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_first_signal_sets_every_event(
    start: Callable[[str], subprocess.Popen[str]], number: signal.Signals
) -> None:
    process = start(WAITS)
    process.send_signal(number)
    assert process.stdout is not None
    assert process.stdout.readline() == "stopped\n"
    assert process.wait(DEADLINE_S) == 0


@pytest.mark.parametrize("script", [STUCK, DEAF])
def test_second_signal_ends_a_worker_that_does_not_listen(
    start: Callable[[str], subprocess.Popen[str]], script: str
) -> None:
    process = start(script)
    process.send_signal(signal.SIGINT)
    ends_s = time.monotonic() + DEADLINE_S
    # When it heard of the first is not known here: one of those that follow is late enough.
    while process.poll() is None and time.monotonic() < ends_s:
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(AGAIN_S)
        process.send_signal(signal.SIGTERM)
    assert process.wait(0) == 128 + signal.SIGTERM


def test_one_wish_told_twice_is_one() -> None:
    """timeout(1) signals its child and then its own group, of which that is: the run ends in order."""
    script = (
        "import os, signal\n"
        "from prism_edge.workers.stopping import StopSignals\n"
        "signals = StopSignals(reload=True); signals.listen()\n"
        "for number in (signal.SIGTERM, signal.SIGTERM, signal.SIGHUP): os.kill(os.getpid(), number)\n"
        "assert signals.reload_wanted.wait(60); assert signals.stopped.is_set()\n"  # heard in their order
    )
    command = [sys.executable, "-c", script]
    done = subprocess.run(command, cwd=CHECKOUT, timeout=DEADLINE_S, start_new_session=True, check=False)
    assert done.returncode == 0


def test_a_signal_before_it_listens_is_heard_then() -> None:
    """The supervisor forks its workers before it has a thread; who ends it meanwhile is not passed over."""
    script = (
        "import os, signal\n"
        "from prism_edge.workers.stopping import StopSignals\n"
        "signals = StopSignals(); os.kill(os.getpid(), signal.SIGTERM)\n"
        "assert not signals.stopped.is_set(); signals.listen(); assert signals.stopped.wait(60)\n"
    )
    assert subprocess.run([sys.executable, "-c", script], cwd=CHECKOUT, timeout=DEADLINE_S).returncode == 0


def test_event_named_after_the_signal_is_set_at_once() -> None:
    script = SETUP + (
        "import os, signal\n"
        "os.kill(os.getpid(), signal.SIGTERM); assert signals.stopped.wait(60)\n"
        "late = threading.Event(); signals.also(late); assert late.is_set()\n"
    )
    assert subprocess.run([sys.executable, "-c", script], cwd=CHECKOUT, timeout=DEADLINE_S).returncode == 0
