"""Whether an MP4 or QuickTime film has its index: cameras write it last, and nothing can be read without."""

from __future__ import annotations

import os
import struct
from contextlib import suppress
from pathlib import Path

_HEADER = struct.Struct(">I4s")
_LONG = struct.Struct(">Q")
_MOST_BOXES = 10_000  # of a fragmented recording there may be many, but its index comes first


def lacks_index(file: Path) -> bool:
    """True of a file whose boxes (ISO/IEC 14496-12, section 4.2) are those of such a film, with no ``moov``.

    False of any other file, and of one that can't be read.
    """
    with suppress(OSError), file.open("rb") as opened:
        size, position = os.fstat(opened.fileno()).st_size, 0
        for _ in range(_MOST_BOXES):
            header = opened.read(_HEADER.size)
            if len(header) < _HEADER.size:
                return position > 0
            length, kind = _HEADER.unpack(header)
            if position == 0 and kind != b"ftyp":
                return False
            if kind == b"moov":
                return position + length > size  # it was being written
            if length == 1:
                longer = opened.read(_LONG.size)
                length = _LONG.unpack(longer)[0] if len(longer) == _LONG.size else 0
            if length < _HEADER.size:  # 0: to the end of the file
                return True
            position += length
            if position >= size:
                return True
            opened.seek(position)
    return False
