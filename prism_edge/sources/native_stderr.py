"""Keeps what native code prints to stderr out of the log."""

from __future__ import annotations

import contextlib
import logging
import os
import threading
from collections.abc import Iterator

from prism_edge import vital

_STDERR = 2
_one_at_a_time = threading.Lock()  # or one would keep what the other put there, and put that back


@contextlib.contextmanager
def native_stderr_unheard() -> Iterator[None]:
    """What is printed to stderr meanwhile goes nowhere; other threads' log lines wait until it is over.

    OpenCV's libjpeg has a line for each picture of cameras that end theirs with bytes too many, as many do:
    thirty a second of pictures that are whole; libpng has one for each that is damaged, beside the reason
    that we give. They know no way to be told not to.
    """
    with contextlib.ExitStack() as after:
        after.enter_context(_one_at_a_time)
        for handler in logging.getLogger().handlers:
            handler.acquire()
            after.callback(handler.release)
        with contextlib.suppress(OSError):  # a process may have no stderr, or no descriptor left
            kept = os.dup(_STDERR)
            after.callback(os.close, kept)
            nowhere = os.open(os.devnull, os.O_WRONLY)
            after.callback(_heard_at, _STDERR)
            after.callback(os.dup2, kept, _STDERR)
            _heard_at(kept)  # what a process says as it ends is heard all the same
            os.dup2(nowhere, _STDERR)
            os.close(nowhere)
        yield


def _heard_at(descriptor: int) -> None:
    vital.stderr = descriptor
