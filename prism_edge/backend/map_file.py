"""Maps as files: named arrays and a few plain values, checked when read, whole or not at all when written.

Layout, little endian (docs/OPERATIONS.md lists what a map holds)::

    0   8s   b"PRISMMAP"
    8   u32  version of this layout
    12  u32  header length H in bytes
    16  u64  length of the whole file
    24  H    JSON: {"info": {name: value}, "arrays": [[name, dtype, [dimension, ...]], ...]}
    ..       the arrays in that order, C order; header and each array padded with zeros to a multiple of 8
    -32 32s  SHA-256 of everything before it

A file comes from outside: nothing in it is run or trusted, and nothing is allocated that it does not contain.
"""

from __future__ import annotations

import contextlib
import glob
import hashlib
import json
import os
import stat
import struct
import tempfile
import time
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from prism_edge.errors import MapError

MAGIC = b"PRISMMAP"
VERSION = 1
LARGEST_FILE = 2 << 30  # bytes; 100 000 keyframes of 700 keypoints would be four times that
LARGEST_HEADER = 1 << 20
DTYPES = ("<i8", "<f8", "<f4", "|u1")
MOST_DIMENSIONS = 3
SUFFIX = ".prismmap"

_PREFIX = struct.Struct("<8sIIQ")
_DIGEST = 32
_FORSAKEN_S = 3600.0  # longer than anybody takes to write a file

Arrays = dict[str, NDArray[Any]]
Info = dict[str, Any]


def pack(info: Info, arrays: Arrays) -> bytes:
    """Plain values (JSON) and arrays (int64, float64, float32 or uint8) as the bytes of a file.

    Raises MapError for what no file can have: a value that is not finite, a header or a map too large.
    """
    shapes, parts = [], []
    for name, array in arrays.items():
        data = np.asarray(array, array.dtype.newbyteorder("<"), order="C")
        shapes.append([name, data.dtype.str, list(data.shape)])
        parts += [data.tobytes(), bytes(-data.nbytes % 8)]
    try:
        header = json.dumps({"info": info, "arrays": shapes}, allow_nan=False).encode()
    except ValueError as error:
        raise MapError(f"the map's header can't be written: {error}") from None
    if len(header) > LARGEST_HEADER:
        raise MapError(f"the map's header would take {len(header)} of {LARGEST_HEADER} bytes")
    parts = [header, bytes(-len(header) % 8), *parts]
    length = _PREFIX.size + sum(map(len, parts)) + _DIGEST
    if length > LARGEST_FILE:
        raise MapError(f"the map would take {length} bytes; one has at most {LARGEST_FILE}")
    body = b"".join([_PREFIX.pack(MAGIC, VERSION, len(header), length), *parts])
    return body + hashlib.sha256(body).digest()


def unpack(data: bytes) -> tuple[Info, Arrays]:
    """What :func:`pack` was given; the arrays are read-only views of ``data``.

    Raises MapError for anything that it would not have written.
    """
    try:
        return _unpack(data)
    except (ValueError, TypeError, KeyError, RecursionError, struct.error) as error:
        raise MapError(f"not a sound map: {error}".replace("\n", " ")[:200]) from None


def _unpack(data: bytes) -> tuple[Info, Arrays]:
    if len(data) < _PREFIX.size + _DIGEST or not data.startswith(MAGIC):
        raise ValueError("it does not begin as a map of prism_edge does")
    _, version, header_length, length = _PREFIX.unpack_from(data)
    if version != VERSION:
        raise ValueError(f"its layout is version {version}, this is version {VERSION}")
    if length != len(data):
        raise ValueError(f"it says that it has {length} bytes, it has {len(data)}: truncated?")
    if hashlib.sha256(memoryview(data)[:-_DIGEST]).digest() != data[-_DIGEST:]:
        raise ValueError("its checksum is wrong: damaged?")
    end = len(data) - _DIGEST
    if header_length > LARGEST_HEADER or _PREFIX.size + header_length > end:
        raise ValueError(f"a header of {header_length} bytes")
    position = _PREFIX.size + header_length
    header = json.loads(data[_PREFIX.size : position], parse_constant=_refuse)
    info, shapes = header["info"], header["arrays"]
    if not isinstance(info, dict) or not isinstance(shapes, list):
        raise ValueError("its header is none")
    position += -position % 8
    arrays: Arrays = {}
    for name, dtype, shape in shapes:
        sizes = isinstance(shape, list) and len(shape) <= MOST_DIMENSIONS
        if not sizes or not all(type(n) is int and 0 <= n <= length for n in shape):
            raise ValueError(f"array {name!r:.40} has the shape {shape!r:.60}")
        if dtype not in DTYPES or not isinstance(name, str) or name in arrays:
            raise ValueError(f"array {name!r:.40} of type {dtype!r:.20}")
        count = prod(shape)
        size = count * np.dtype(dtype).itemsize
        if position + size > end:
            raise ValueError(f"array {name!r:.40} is not all there")
        flat = np.frombuffer(data, dtype, count, position) if count else np.empty(0, dtype)
        arrays[name] = flat.reshape(shape)
        position += size + -size % 8
    if position != end:
        raise ValueError(f"{end - position} bytes too many")
    return info, arrays


def _refuse(word: str) -> Any:
    raise ValueError(f"{word} in the header")


def write(path: Path, data: bytes, durable: bool = True) -> None:
    """Put a file in place at once: whoever reads it finds the old one or the new one, whole.

    With ``durable`` even after a power cut. Raises MapError, with nothing left behind, where it can't be
    written (a full disk, say).
    """
    _sweep_forsaken_maps(path.parent)
    new = ""
    try:
        descriptor, new = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
        with os.fdopen(descriptor, "wb") as file:
            file.write(data)
            if durable:
                file.flush()
                os.fsync(file.fileno())
        os.replace(new, path)
        if durable:
            folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
            try:
                os.fsync(folder)
            finally:
                os.close(folder)
    except OSError as error:
        if new:
            with contextlib.suppress(OSError):
                os.unlink(new)
        raise MapError(f"can't write {path}: {error.strerror or error}") from None


def sweep(path: Path) -> None:
    """Remove what is left of :func:`write` where it was killed: a file that nobody would ever read."""
    for left in path.parent.glob(f".{glob.escape(path.name)}.*"):
        with contextlib.suppress(OSError):
            left.unlink()


def _sweep_forsaken_maps(folder: Path) -> None:
    """The same for all maps of a folder, where another may just be being written."""
    for left in folder.glob(f".*{SUFFIX}.*"):
        with contextlib.suppress(OSError):
            if time.time() - left.stat().st_mtime > _FORSAKEN_S:
                left.unlink()


def read(path: Path, largest: int = LARGEST_FILE) -> bytes:
    """The bytes of a map's file. Raises MapError where there is none, or one that can't be a map."""
    try:
        # A pipe would be waited for.
        with open(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb") as file:
            status = os.fstat(file.fileno())
            if not stat.S_ISREG(status.st_mode):
                raise MapError(f"{path}: is no file")
            if status.st_size > largest:
                raise MapError(f"{path}: has {status.st_size} bytes; a map has at most {largest}")
            return file.read(largest + 1)
    except OSError as error:
        raise MapError(f"{path}: can't read the map: {error.strerror or error}") from None
