"""Threads without which a process hears, or says, nothing more."""

from __future__ import annotations

import logging
import os
import threading
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from prism_edge.errors import UNEXPECTED

log = logging.getLogger("prism_edge")


def vital(run: Callable[..., object], name: str, args: tuple[Any, ...] = ()) -> threading.Thread:
    """A thread, not begun yet, whose failure ends the process at once.

    Without it the process would live on as if it hung, until the supervisor's patience is over; ended, it is
    started again within the second. Where memory is short not even that is sure to be logged.
    """
    return threading.Thread(target=_to_the_end, args=(run, args), name=name, daemon=True)


def _to_the_end(run: Callable[..., object], args: tuple[Any, ...]) -> None:
    try:
        run(*args)
    except BaseException:  # of any kind: nobody else would see it
        try:
            name = threading.current_thread().name
            log.exception("the thread %s failed; please report it with the lines below", name)
            logging.shutdown()
        finally:
            _end()


def _end() -> None:
    while True:
        with suppress(MemoryError):  # there may be too little even for that call, for a moment
            os._exit(UNEXPECTED)
