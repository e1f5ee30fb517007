"""A session whose liveliness tokens the tests make."""

from __future__ import annotations

import queue
from types import SimpleNamespace
from typing import Any

import zenoh


class Session:
    """As much of a Zenoh session as liveliness takes, for tokens below one key; counts subscriptions."""

    def __init__(self, below: str) -> None:
        self.subscriptions = 0
        self._below = below
        self._tokens: queue.Queue[Any] = queue.Queue()
        self.handler = self

    def liveliness(self) -> Session:
        return self

    def declare_subscriber(self, key: str, channel: object, history: bool) -> Session:
        assert key == f"{self._below}/*"
        assert history  # those that were there before
        self.subscriptions += 1
        return self

    def recv(self) -> Any:
        token = self._tokens.get()
        if token is None:
            raise zenoh.ZError("undeclared")
        return token

    def undeclare(self) -> None:
        self._tokens.put(None)

    def says(self, name: str, there: bool) -> None:
        kind = zenoh.SampleKind.PUT if there else zenoh.SampleKind.DELETE
        self._tokens.put(SimpleNamespace(key_expr=f"{self._below}/{name}", kind=kind))
