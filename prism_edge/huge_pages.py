"""Large pages behind the C library's heap, where the kernel leaves the choice to each program.

A frame's images and arrays lie on a thousand pages of 4 kB, which the processor looks up anew after whatever
ran in between; on a virtual machine each look is two dozen reads. Of 2 MB each they are a few.
"""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Mapping
from pathlib import Path

KERNEL = Path("/sys/kernel/mm/transparent_hugepage")
LARGEST = 2 << 20  # bytes: with 64 kB of base pages a huge one has 512 MB, and each process would take some
VARIABLE, TUNABLE = "GLIBC_TUNABLES", "glibc.malloc.hugetlb"
BEGUN = "PRISM_EDGE_BEGUN"  # the process that has begun anew
SINCE = (2, 35)  # of glibc


def with_huge_pages(environment: Mapping[str, str], kernel: Path = KERNEL) -> dict[str, str]:
    """An environment in which a program gets them; the same where it can't, needn't, or was told otherwise.

    The C library reads it when a program begins, and does the rest as the heap grows and shrinks.
    """
    given = environment.get(VARIABLE, "")
    if TUNABLE in given or not _are_for_who_asks(kernel) or _glibc() < SINCE:
        return dict(environment)
    return {**environment, VARIABLE: f"{given}:{TUNABLE}=1".removeprefix(":")}


def begin_with_huge_pages() -> None:
    """Begin the same command line anew where that gives it huge pages.

    Same process, so that whoever started it finds it still; once, whatever its environment has then: the C
    library takes the variable away from a program with capabilities of its own (``setcap``).
    """
    wanted, own = with_huge_pages(os.environ), str(os.getpid())
    if wanted == dict(os.environ) or os.environ.get(BEGUN) == own or not _is_all_there_is():
        return
    with contextlib.suppress(OSError):  # confined: it may not, and goes on as it is
        os.execve(sys.executable, [sys.executable, *sys.orig_argv[1:]], {**wanted, BEGUN: own})


def _is_all_there_is() -> bool:
    """Whether the interpreter's command line leads here again, and nothing before is lost by that.

    Not where another program calls us with words of its own, where a program came by stdin, which is read
    already, or where a debugger has its breakpoints.
    """
    words = sys.argv[1:]
    given = bool(words) and sys.orig_argv[-len(words) :] == words and sys.argv[0] != "-"
    return given and not sys.gettrace() and os.access(sys.executable, os.X_OK)


def _are_for_who_asks(kernel: Path) -> bool:
    """Whether the kernel gives them, of a size that suits, to programs that ask; to all or none: no."""
    try:
        asked = "[madvise]" in (kernel / "enabled").read_text()
        return asked and int((kernel / "hpage_pmd_size").read_text()) <= LARGEST
    except (OSError, ValueError):
        return False


def _glibc() -> tuple[int, ...]:
    """The C library's version; (0,) where it is another one."""
    try:
        name, _, version = (os.confstr("CS_GNU_LIBC_VERSION") or "").partition(" ")
        return tuple(map(int, version.split("."))) if name == "glibc" else (0,)
    except (ValueError, OSError):  # another system has no such name, or none of digits
        return (0,)
