"""What arrives at a Zenoh subscription or queryable, until that ends."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from typing import Any

import zenoh

_OVER_S = 5.0  # for a thread to come back from recv(), on a busy machine too


def arriving(declared: Any) -> Iterator[Any]:
    """Each sample or query, waiting for the next; ends when ``declared`` is undeclared.

    It keeps none of them: a query that somebody holds keeps its asker waiting.
    """
    handler = declared.handler  # one that waits in its own recv() can't be undeclared
    try:
        while True:
            yield handler.recv()
    except zenoh.ZError:
        return


def no_more(declared: Any, thread: threading.Thread) -> None:
    """Undeclare what a thread takes arrivals of, and wait for the thread, unless that is who asks.

    One that came back from Zenoh's code only while Python shuts down would abort the process.
    """
    declared.undeclare()
    if threading.current_thread() is not thread:
        thread.join(timeout=_OVER_S)
