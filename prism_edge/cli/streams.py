"""stdin, stdout and stderr, where whoever started a command closed them or reads no further."""

from __future__ import annotations

import io
import os
import sys


def open_closed() -> None:
    """Open /dev/null in the place of each that is closed: the next file to be opened would take it."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            # Which takes the lowest number that is free: this one.
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)
        if getattr(sys, name) is None:
            setattr(sys, name, open(number, "w" if number else "r", closefd=False))  # noqa: SIM115


def print_anything() -> None:
    """What stdout's encoding has no letters for is escaped, not an error: a file's name may be no text."""
    if isinstance(sys.stdout, io.TextIOWrapper) and sys.stdout.errors == "strict":
        sys.stdout.reconfigure(errors="backslashreplace")


def drop_output() -> None:
    """What could not be written is tried once more when Python ends, which would complain again."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
