"""Leaving the bus without waiting for who does not read."""

from __future__ import annotations

import _thread
import logging
import os
import sys
import threading
from collections.abc import Callable

# In real time, less than a worker has for it: Zenoh waits ten seconds for a receiver that hangs.
PATIENCE_S = 1.0

log = logging.getLogger("prism_edge.bus")
_unfinished: list[threading.Event] = []  # each set once a bus that took long is left


def leave(close: Callable[[], object], patience_s: float | None) -> None:
    """Do ``close`` in a thread of its own, and wait for it so long; None: until it is done."""
    left = threading.Event()

    def go() -> None:
        try:
            close()
        finally:
            left.set()

    try:
        # Not threading's, which waits for good for one that found no memory to begin with.
        _thread.start_new_thread(go, ())
    except RuntimeError:  # from 3.12 on no thread begins once Python ends
        close()
        return
    if not left.wait(patience_s):
        _unfinished.append(left)
        log.warning("somebody does not read what he is sent, or all is slow: the bus is left all the same")


def ended(code: int) -> int:
    """The exit code of a process that has nothing left to do but to end; call in its last line.

    It ends here where a bus is still being left: Python's own end may not meet native code that comes back.
    """
    if not all(left.is_set() for left in _unfinished):
        logging.shutdown()
        for stream in (sys.stdout, sys.stderr):
            try:
                stream.flush()
            except (OSError, ValueError, AttributeError):  # its reader has gone, or it was closed
                continue
        os._exit(code)
    return code
