"""An answer that the worker's own thread makes, for a query that another thread has to answer."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

PATIENCE_S = 25.0  # the worker may be in the midst of a solve: longer than one may take


class Handover:
    """:meth:`ask` waits in the asking thread until :meth:`serve` has been called in the worker's.

    Each question has a number, and an answer counts for the one that it was begun for: what is made for an
    asker who has given up meanwhile is dropped, also where he asks again.
    """

    def __init__(self, patience_s: float = PATIENCE_S) -> None:
        self._patience_s = patience_s
        self._changed = threading.Condition()  # guards all below
        self._asked = self._begun = self._made = 0  # the newest question, and those last begun and answered
        self._wanted = 0  # the question that is waited for; 0: none
        self._result: Any | None = None

    @property
    def wanted(self) -> bool:
        """Whether an answer is waited for that is not begun."""
        return self._wanted not in (0, self._begun)

    def ask(self) -> Any | None:
        """What the worker makes from now on; None where it does not in time. One thread asks."""
        with self._changed:
            self._asked += 1
            self._wanted = self._asked
            self._changed.wait_for(lambda: self._made == self._asked, self._patience_s)
            self._wanted = 0
            result, self._result = self._result, None
            return result

    def serve(self, make: Callable[[], Any | None]) -> None:
        """Make what is asked for; costs nothing where that is nothing. One thread serves."""
        with self._changed:
            if not self.wanted:
                return
            question = self._begun = self._wanted
        result = make()
        with self._changed:
            if question == self._wanted:
                self._result, self._made = result, question
                self._changed.notify()
