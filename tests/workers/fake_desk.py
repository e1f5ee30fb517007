"""A command desk without a bus: a test asks, the worker's thread serves."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping

from prism_edge.bus.commands import Handler, Reply
from prism_edge.errors import PrismError


class FakeDesk:
    """Commands wait until the worker serves them; what came of each is then in ``replies``."""

    def __init__(self) -> None:
        self.handlers: dict[str, Handler] = {}
        self.waiting: deque[tuple[str, str]] = deque()
        self.replies: list[Reply] = []
        self.before_serving: Callable[[], None] = lambda: None

    def open(self, handlers: Mapping[str, Handler]) -> FakeDesk:
        self.handlers.update(handlers)
        return self

    def ask(self, name: str, argument: str = "") -> None:
        self.waiting.append((name, argument))

    def serve(self) -> None:
        self.before_serving()
        while self.waiting:
            name, argument = self.waiting.popleft()
            try:
                self.replies.append(self.handlers[name](argument))
            except PrismError as error:
                self.replies.append(Reply(False, str(error)))
