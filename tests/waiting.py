"""Waiting in tests for what other threads and processes do."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any


def until(condition: Callable[[], Any], what: str = "", deadline_s: float = 30.0) -> Any:
    """What ``condition`` returns, as soon as that is true. An AssertionError of ``what`` at the deadline."""
    end = time.monotonic() + deadline_s
    while not (found := condition()):
        assert time.monotonic() < end, f"waited {deadline_s:g} s in vain: {what or 'no condition named'}"
        time.sleep(0.005)
    return found
