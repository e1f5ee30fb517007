"""What a restarted backend recovers its map from: a map, and what has come since, each record checked.

Two files in one folder. ``base`` is a map (map_file.py) whose ``generation`` says which ``tail`` goes on from
it. The tail is records, each ``<4s I I`` b"PRJR", length and CRC-32 of the bytes that follow; the first
record is the generation. A tail of another generation, and whatever follows an unsound record, is ignored:
a kill at any moment costs the record that was being written, no more.
"""

from __future__ import annotations

import contextlib
import os
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

from prism_edge.backend import map_file
from prism_edge.backend.map_file import Arrays, Info
from prism_edge.errors import MapError

LEAST_TAIL = 4 << 20  # bytes before a new base is worth while
LARGEST_RECORD = 64 << 20

_MAGIC = b"PRJR"
_HEAD = struct.Struct("<4sII")
_GENERATION = struct.Struct("<Q")


class Journal:
    """Bounded: a tail that has grown beyond its base gives way to a new base."""

    def __init__(self, folder: Path) -> None:
        """Raises MapError where the folder can't be made."""
        self._base, self._tail = folder / "base", folder / "tail"
        self._generation, self._base_size, self._tail_size = 0, 0, 0
        self._file: BinaryIO | None = None
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise MapError(f"can't keep a journal in {folder}: {error.strerror or error}") from None
        map_file.sweep(self._base)  # a base that was being written when a life before this one ended

    def recover(self) -> tuple[Info, Arrays, list[bytes]] | None:
        """The base and the records since; None where there is no sound base."""
        try:
            data = map_file.read(self._base)
            info, arrays = map_file.unpack(data)
            generation = info.pop("generation")
            records = _records(map_file.read(self._tail)) if os.path.exists(self._tail) else []
        except (MapError, KeyError):
            return None
        if not isinstance(generation, int) or not 0 <= generation < 2**63:
            return None
        self._generation = generation
        belongs = records and records[0] == _GENERATION.pack(generation)
        return info, arrays, records[1:] if belongs else []

    def begin(self, pack: Callable[[int], bytes]) -> None:
        """Write a new base, what ``pack`` makes for a generation, and go on from it. Raises MapError."""
        self.close()
        with contextlib.suppress(OSError):  # said below; a folder above that has gone is not ours to make
            self._base.parent.mkdir(exist_ok=True)  # a cleaner may have taken it
        generation = self._generation + 1
        data = pack(generation)
        map_file.write(self._base, data, durable=False)  # for a process that dies, not for a power cut
        self._generation, self._base_size, self._tail_size = generation, len(data), 0
        try:
            self._tail.unlink(missing_ok=True)
            self._file = open(  # noqa: SIM115 - open until the next base
                self._tail, "xb", buffering=0, opener=lambda path, flags: os.open(path, flags, 0o600)
            )
        except OSError as error:
            raise MapError(f"can't write {self._tail}: {error.strerror or error}") from None
        self.append(_GENERATION.pack(generation))

    def append(self, record: bytes) -> None:
        """Add a record. Raises MapError where it can't be written; the next :meth:`begin` tries afresh.

        Nothing is added to half a record: what follows one is never read.
        """
        if self._file is None:
            raise MapError("the journal has no base to go on from")
        data = _HEAD.pack(_MAGIC, len(record), zlib.crc32(record)) + record
        try:
            if os.fstat(self._file.fileno()).st_nlink == 0 or not os.path.exists(self._base):
                self.close()
                raise MapError(f"the journal in {self._base.parent} has been removed")  # a cleaner's work
            if self._file.write(data) != len(data):
                self.close()
                raise MapError(f"can't write all of a record to {self._tail}")
        except OSError as error:
            self.close()
            raise MapError(f"can't write {self._tail}: {error.strerror or error}") from None
        self._tail_size += len(data)

    @property
    def is_open(self) -> bool:
        """Whether records can be added."""
        return self._file is not None

    @property
    def is_long(self) -> bool:
        """Whether a new base is due."""
        return self._tail_size > max(LEAST_TAIL, self._base_size)

    def clear(self) -> None:
        """Forget everything: a run that begins has nothing to recover."""
        self.close()
        for path in (self._tail, self._base):
            with contextlib.suppress(OSError):
                path.unlink(missing_ok=True)

    def close(self) -> None:
        """Close the file; what was written stays."""
        if self._file is not None:
            with contextlib.suppress(OSError):
                self._file.close()
            self._file = None


def _records(data: bytes) -> list[bytes]:
    """The sound records from the beginning on."""
    records, position = [], 0
    while position + _HEAD.size <= len(data):
        magic, length, checksum = _HEAD.unpack_from(data, position)
        start = position + _HEAD.size
        record = data[start : start + length]
        sound = magic == _MAGIC and len(record) == length <= LARGEST_RECORD
        if not sound or zlib.crc32(record) != checksum:
            break
        records.append(record)
        position = start + length
    return records

