"""Files that are written whole or not at all: one cut short might be read as another."""

from __future__ import annotations

import os
import shutil
from pathlib import Path


def put_whole(path: Path, data: bytes) -> None:
    """What was there stays until all is written. Raises OSError with the file's name."""
    try:
        file = path.resolve()  # what a link leads to is replaced, not the link
        temporary = beside(file)
        try:
            temporary.write_bytes(data)
            if file.exists():  # who may read it stays its owner's to say
                shutil.copymode(file, temporary)
            temporary.replace(file)
        finally:  # of whoever loses patience, too
            temporary.unlink(missing_ok=True)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from None


def beside(path: Path) -> Path:
    """In the folder of the file itself, and short: a name may be as long as the system lets it."""
    return path.with_name(f".prism-edge.{os.getpid()}")
