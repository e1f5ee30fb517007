"""Files and folders as people name them."""

from __future__ import annotations

import errno
import os
from pathlib import Path


def named_path(name: str) -> Path:
    """A leading ~ is a user's home, as in a shell; where there is no such user or home it stays, as there."""
    return Path(os.path.expanduser(name))


def hindrance(path: Path) -> str:
    """What keeps us from looking whether a file is there, such as a closed folder; empty: nothing does."""
    try:
        path.stat()
    except (FileNotFoundError, NotADirectoryError, ValueError):  # a NUL in the name
        return ""
    except OSError as error:
        return error.strerror or type(error).__name__
    return ""


def refuse_pipe(path: Path) -> None:
    """Raises OSError for a pipe: reading it may never come to an end."""
    if path.is_fifo():
        raise OSError(errno.EINVAL, "a pipe, not a file", str(path))
