"""Leaving the bus without waiting for who does not read."""

from __future__ import annotations

import logging
import os
import sys
import threading
from collections.abc import Callable

# In real time, less than a worker has for it: Zenoh waits ten seconds for a receiver that hangs.
PATIENCE_S = 1.0

log = logging.getLogger("prism_edge.bus")
_unfinished: list[threading.Thread] = []


def leave(close: Callable[[], object], patience_s: float | None) -> None:
    """Do ``close`` in a thread of its own, and wait for it so long; None: until it is done."""
    leaving = threading.Thread(target=close, name="leaving", daemon=True)
    try:
        leaving.start()
    except RuntimeError:  # from 3.12 on no thread begins once Python ends
        close()
        return
    leaving.join(patience_s)
    if leaving.is_alive():
        _unfinished.append(leaving)
        log.warning("somebody does not read what he is sent, or all is slow: the bus is left all the same")


def ended(code: int) -> int:
    """The exit code of a process that has nothing left to do but to end; call in its last line.

    It ends here where a bus is still being left: Python's own end may not meet native code that comes back.
    """
    if any(thread.is_alive() for thread in _unfinished):
        logging.shutdown()
        for stream in (sys.stdout, sys.stderr):
            try:
                stream.flush()
            except (OSError, ValueError, AttributeError):  # its reader has gone, or it was closed
                continue
        os._exit(code)
    return code
