"""The C library's heap kept from growing with every peak: a worker runs for weeks."""

from __future__ import annotations

import contextlib
import ctypes
import threading
from collections.abc import Callable

# <malloc.h>
_TRIM_THRESHOLD, _MMAP_THRESHOLD, _ARENA_MAX = -1, -3, -8

# By default glibc raises both thresholds with the largest block that was ever freed, up to 32 and 64 MB, and
# keeps what lies below them; and threads that hardly allocate get arenas of their own.
MAPPED_BYTES = 2 << 20  # a block this large goes back when it is freed
KEPT_BYTES = 8 << 20  # free at the heap's end: an image's temporaries must not be mapped anew each time
ARENAS = 2
TRIM_S = 60.0


def bound_heap() -> bool:
    """Set the limits; False where the C library knows none (it is not glibc)."""
    with contextlib.suppress(AttributeError, OSError):
        mallopt = ctypes.CDLL(None).mallopt
        limits = ((_MMAP_THRESHOLD, MAPPED_BYTES), (_TRIM_THRESHOLD, KEPT_BYTES), (_ARENA_MAX, ARENAS))
        return 0 not in [mallopt(name, value) for name, value in limits]
    return False


def keep_trimmed(stopped: threading.Event, every_s: float = TRIM_S) -> None:
    """Give back, now and then, what is free in the midst of the heap too: solvers leave it full of holes.

    In a thread of its own, without the interpreter's lock; it takes some milliseconds.
    """
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is None:
        return

    def go_on(trim: Callable[[int], int]) -> None:
        while not stopped.wait(every_s):
            trim(0)

    threading.Thread(target=go_on, args=(trim,), name="heap", daemon=True).start()
