"""Threads without which a process hears, or says, nothing more."""

from __future__ import annotations

import logging
import os
import threading
from collections.abc import Callable
from typing import Any, NoReturn

from prism_edge.errors import UNEXPECTED

log = logging.getLogger("prism_edge")

stderr = 2  # elsewhere for as long as native code's lines are kept out of the log


def vital(run: Callable[..., object], name: str, args: tuple[Any, ...] = ()) -> threading.Thread:
    """A thread, not begun yet, whose failure ends the process at once.

    Without it the process would live on as if it hung, until the supervisor's patience is over; ended, it is
    started again within the second.
    """
    starved = words_of_starved(f"the thread {name}")
    return threading.Thread(target=_to_the_end, args=(run, args, starved), name=name, daemon=True)


def words_of_starved(who: str) -> bytes:
    """What :func:`end_starved` is to say; made while there is memory."""
    return f"{who} failed: MemoryError\n".encode()


def end_starved(words: bytes) -> NoReturn:
    """End a process that can allocate nothing any more.

    Nothing here may allocate, wait for the log (who died with its lock in hand never gives it back), or begin
    a thread: that would wait for good for one that found no memory to begin with.
    """
    try:
        os.write(stderr, words)
    finally:
        while True:
            try:  # noqa: SIM105 - suppress() is an object
                os._exit(UNEXPECTED)
            except MemoryError:
                pass


def _to_the_end(run: Callable[..., object], args: tuple[Any, ...], starved: bytes) -> None:
    try:
        run(*args)
    except BaseException as error:  # of any kind: nobody else would see it
        if type(error) is MemoryError:  # numpy's own is of one array that is too large
            end_starved(starved)
        try:
            name = threading.current_thread().name
            log.exception("the thread %s failed; please report it with the lines below", name)
            logging.shutdown()
        finally:
            os._exit(UNEXPECTED)
