"""The boxes of an MP4 or QuickTime film (ISO/IEC 14496-12): whether its index is there, and how long it is.

Cameras write the index last, and nothing can be read without.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO

_HEADER = struct.Struct(">I4s")
_LONG = struct.Struct(">Q")
_MOST_BOXES = 10_000  # of a fragmented recording there may be many, but its index comes first
_LENGTHS = {0: struct.Struct(">12xII"), 1: struct.Struct(">20xIQ")}  # of mvhd's versions: timescale, duration
_MVHD = 32  # bytes of it, at most, that say so
_UNKNOWN = (0, 0xFFFFFFFF, 0xFFFFFFFFFFFFFFFF)  # durations that say nothing, as where fragments follow


def lacks_index(file: Path) -> bool:
    """True of a file whose boxes (section 4.2) are those of such a film, with no ``moov``.

    False of any other file, and of one that can't be read.
    """
    with suppress(OSError), file.open("rb") as opened:
        size = os.fstat(opened.fileno()).st_size
        for number, (kind, _, end) in enumerate(_boxes(opened, 0, size)):
            if number == 0 and kind != b"ftyp":
                return False
            if kind == b"moov":
                return end > size  # it was being written
        return size >= _HEADER.size
    return False


def shown_ns(file: Path) -> int:
    """How long such a film is as it is shown (section 8.2.2); 0 where it doesn't say it, and of any other.

    What an edit list hides, as lossless trimming leaves it before the first frame, is not in it.
    """
    with suppress(OSError, struct.error), file.open("rb") as opened:
        start, end = 0, os.fstat(opened.fileno()).st_size
        for wanted in (b"moov", b"mvhd"):
            inside = (box for box in _boxes(opened, start, end) if box[0] == wanted)
            _, start, its_end = next(inside, (b"", 0, 0))
            end = min(its_end, end)  # whatever a damaged film says
        opened.seek(start)
        scale, duration = _duration(opened.read(max(min(end - start, _MVHD), 0)))
        return round(1e9 * duration / scale) if scale and duration not in _UNKNOWN else 0
    return 0


def _duration(header: bytes) -> tuple[int, int]:
    return _LENGTHS[header[0]].unpack_from(header) if header[:1] in (b"\0", b"\1") else (0, 0)


def _boxes(opened: BinaryIO, position: int, size: int) -> Iterator[tuple[bytes, int, int]]:
    """The kind of each box from ``position`` up to ``size``, where its content begins, and its end."""
    for _ in range(_MOST_BOXES):
        if position >= size:
            return
        opened.seek(position)
        header = opened.read(_HEADER.size)
        if len(header) < _HEADER.size:
            return
        length, kind = _HEADER.unpack(header)
        body = position + _HEADER.size
        if length == 1:
            longer = opened.read(_LONG.size)
            body += len(longer)
            length = _LONG.unpack(longer)[0] if len(longer) == _LONG.size else 0
        if length < _HEADER.size:  # 0: to the end of the file
            length = size - position
        yield kind, body, position + length
        position += length
