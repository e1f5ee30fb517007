"""An answer that the worker's own thread makes, for a query that another thread has to answer."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

PATIENCE_S = 25.0  # the worker may be in the midst of a solve: longer than one may take


class Handover:
    """:meth:`ask` waits in the asking thread until :meth:`serve` has been called in the worker's."""

    def __init__(self, patience_s: float = PATIENCE_S) -> None:
        self._patience_s = patience_s
        self._wanted, self._made = threading.Event(), threading.Event()
        self._result: Any | None = None

    def ask(self) -> Any | None:
        """What the worker makes; None where it does not in time. One thread asks."""
        self._made.clear()
        self._wanted.set()
        if not self._made.wait(self._patience_s):
            self._wanted.clear()
            return None
        result, self._result = self._result, None
        return result

    def serve(self, make: Callable[[], Any | None]) -> None:
        """Make what is asked for; costs nothing where that is nothing."""
        if self._wanted.is_set():
            self._wanted.clear()
            self._result = make()
            self._made.set()
