"""What arrives at a Zenoh subscription or queryable, until that ends."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import zenoh


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
