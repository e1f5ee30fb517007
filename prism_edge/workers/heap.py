"""The C library's heap kept from growing with every peak: a worker runs for weeks."""

from __future__ import annotations

import contextlib
import ctypes
import resource
import threading
from collections.abc import Callable
from pathlib import Path

_STATM = Path("/proc/self/statm")
# <malloc.h>
_TRIM_THRESHOLD, _MMAP_THRESHOLD, _ARENA_MAX = -1, -3, -8

# By default glibc raises both thresholds with the largest block that was ever freed, up to 32 and 64 MB, and
# keeps what lies below them; and threads that hardly allocate get arenas of their own.
# A block this large goes back when it is freed. An image of 1920 x 1080 is smaller: each page that is mapped
# anew costs as much as working through it.
MAPPED_BYTES = 8 << 20
KEPT_BYTES = 32 << 20  # free at the heap's end: such an image's temporaries
ARENAS = 2
TRIM_S = 60.0  # from look to look
GROWN_BYTES = 8 << 20
SELDOM = 10  # looks after which it is done all the same


def bound_heap() -> bool:
    """Set the limits; False where the C library knows none (it is not glibc)."""
    with contextlib.suppress(AttributeError, OSError):
        mallopt = ctypes.CDLL(None).mallopt
        limits = ((_MMAP_THRESHOLD, MAPPED_BYTES), (_TRIM_THRESHOLD, KEPT_BYTES), (_ARENA_MAX, ARENAS))
        return 0 not in [mallopt(name, value) for name, value in limits]
    return False


def keep_trimmed(stopped: threading.Event, every_s: float = TRIM_S) -> None:
    """Give back what is free within the heap too, once there is more: solvers leave it full of holes.

    Each time splits the heap's huge pages (huge_pages.py), and what work needs again comes in small ones: so
    it is not done where the process is as large as it was a while after the last time. In a thread of its
    own, without the interpreter's lock; it takes some milliseconds.
    """
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is None:
        return

    def go_on(trim: Callable[[int], int]) -> None:
        usual, looks = 0, 0  # bytes, a while after the last time (0: not known yet), and looks since
        while not stopped.wait(every_s):
            now, looks = _resident(), looks + 1
            # In the end all the same: what was usual may have been a peak, as where a network was loaded.
            if looks >= SELDOM or (usual and now > usual + GROWN_BYTES):
                trim(0)
                usual = looks = 0
            elif not usual:
                usual = now

    threading.Thread(target=go_on, args=(trim,), name="heap", daemon=True).start()


def _resident() -> int:
    """Bytes of this process in memory; 0 where the system doesn't say."""
    with contextlib.suppress(OSError, ValueError, IndexError):
        return int(_STATM.read_text().split()[1]) * resource.getpagesize()
    return 0
