"""How far a run's images have gone out, for the source's next life where the tracker has died with it."""

from __future__ import annotations

import contextlib
import os
import struct
from pathlib import Path

NAME = "position"  # in a run's folder
_RECORD = struct.Struct("<qq")  # index and stamp (ns) of the last image; so small a write is done or not


class Position:
    """The last image that went out, in a file. Without it a recording begins anew."""

    def __init__(self, folder: Path | None) -> None:
        """``folder`` is the run's; None: of a source started by hand, nothing is kept."""
        self._file: int | None = None
        if folder is not None:
            with contextlib.suppress(OSError):
                flags = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW
                self._file = os.open(folder / NAME, flags, 0o600)

    def note(self, index: int, stamp_ns: int) -> None:
        """An image has gone out."""
        if self._file is not None:
            with contextlib.suppress(OSError):
                os.pwrite(self._file, _RECORD.pack(index, stamp_ns), 0)

    def read(self) -> tuple[int, int] | None:
        """Index and stamp (ns) of the last, whichever life sent it; None where there is none."""
        with contextlib.suppress(OSError, struct.error):
            if self._file is not None:
                index, stamp_ns = _RECORD.unpack(os.pread(self._file, _RECORD.size, 0))
                return index, stamp_ns
        return None
