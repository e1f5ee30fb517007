"""Answering get()s on one key, from a thread of its own."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any

import zenoh

from prism_edge.bus.arriving import arriving, no_more
from prism_edge.vital import vital

log = logging.getLogger("prism_edge.bus")


class Answer:
    """A queryable. Not one of Zenoh's callbacks: their threads keep the process from ending."""

    def __init__(
        self, session: Any, key: str, payload: Callable[[], bytes | None], encoding: Any, own: bool = False
    ) -> None:
        """``payload`` is called for each query, in this object's thread; None is no answer.

        ``own``: between our processes, which ask by name. Who asks for ``prism/robot/**`` means what is
        public: for him no process is to pack a whole map while frames wait.
        """
        self._key, self._payload, self._encoding, self._own = key, payload, encoding, own
        self._queryable = session.declare_queryable(key, zenoh.handlers.FifoChannel(64))
        self._thread = vital(self._run, "answer")
        self._thread.start()

    def close(self) -> None:
        """Ends the queryable and its thread."""
        no_more(self._queryable, self._thread)

    def _run(self) -> None:
        for query in arriving(self._queryable):
            with query:
                self._reply(query)
            del query  # else it, and with it the asker, would wait for the next one

    def _reply(self, query: Any) -> None:
        if self._own and str(query.key_expr) != self._key:
            return
        try:
            data = self._payload()
            if data is not None:
                query.reply(self._key, data, encoding=self._encoding)
        except MemoryError:  # a lock may be left held by it, for which the worker waits
            raise
        except Exception as error:  # the worker's function may raise anything, and nobody else would see it
            log.error("can't answer for %s: %s: %s", self._key, type(error).__name__, error)
