"""How far a run's images have gone out, for the source's next life where the tracker has died with it."""

from __future__ import annotations

import contextlib
import os
import struct
from dataclasses import astuple, dataclass
from pathlib import Path

from prism_edge.sources.live.wall_clock import since_boot_ns

NAME = "position"  # in a run's folder
_RECORD = struct.Struct("<qqq")  # a Sent; so small a write is done or not


@dataclass(frozen=True)
class Sent:
    """An image that went out: number, stamp, and when it was taken, since the computer's start (ns)."""

    index: int
    stamp_ns: int
    since_boot_ns: int


class Position:
    """The last image that went out, in a file. Without it a recording begins anew."""

    def __init__(self, folder: Path | None) -> None:
        """``folder`` is the run's; None: of a source started by hand, nothing is kept."""
        self._folder, self._file = folder, None if folder is None else _opened(folder)

    def note(self, sent: Sent) -> None:
        """An image has gone out."""
        if self._file is not None:
            with contextlib.suppress(OSError):
                self._restore()
                os.pwrite(self._file, _RECORD.pack(*astuple(sent)), 0)

    def read(self) -> Sent | None:
        """The last, whichever life sent it; None where there is none."""
        with contextlib.suppress(OSError, struct.error):
            if self._file is not None:
                return Sent(*_RECORD.unpack(os.pread(self._file, _RECORD.size, 0)))
        return None

    def _restore(self) -> None:
        """Somebody may have cleared the folder, which the supervisor makes anew."""
        if self._file is not None and self._folder is not None and os.fstat(self._file).st_nlink == 0:
            new = _opened(self._folder)
            if new is not None:
                os.close(self._file)
                self._file = new


def _opened(folder: Path) -> int | None:
    with contextlib.suppress(OSError):
        return os.open(folder / NAME, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
    return None


@dataclass(frozen=True)
class Before:
    """What a live source's lives before this one sent: its numbers and stamps go on from there."""

    index: int
    stamp_ns: int
    ahead_ns: int | None  # of the stamps, of the time since the computer's start; None where nobody knows

    @classmethod
    def of(cls, tracked: tuple[int, int] | None, sent: Sent | None) -> Before | None:
        """By index and stamp (ns) of the last image ``tracked``, and the last ``sent``."""
        ends = [end for end in (tracked, None if sent is None else (sent.index, sent.stamp_ns)) if end]
        if not ends:
            return None
        ahead_ns = None if sent is None else sent.stamp_ns - sent.since_boot_ns
        return cls(max(index for index, _ in ends), max(stamp_ns for _, stamp_ns in ends), ahead_ns)

    def shift_ns(self, stamp_ns: int, captured_ns: int, period_ns: int) -> int:
        """What the first image's stamp, and all after it, are to be moved by.

        To the wall clock as it stood when the run began: set meanwhile, it would make the time that the
        source was away hours, or nothing. In no case back behind what has been sent.
        """
        known = 0 if self.ahead_ns is None else self.ahead_ns + since_boot_ns(captured_ns) - stamp_ns
        return max(known, self.stamp_ns + period_ns - stamp_ns)
