"""Reading one image file, and telling a whole one from one that was cut short."""

from __future__ import annotations

import contextlib
import os
import re
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from prism_edge.messages import U8
from prism_edge.sources.native_stderr import native_stderr_unheard

U16 = NDArray[np.uint16]

SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".pgm", ".ppm", ".tif", ".tiff", ".webp")

# Grey stays grey, alpha goes; intrinsics belong to the image as stored, so a rotation that the file asks
# for is not made.
_FLAGS = cv2.IMREAD_ANYCOLOR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION

_BITS = (8, 10, 12, 14, 16)  # that cameras have; most store them as they are in files of 16

_JPEG_START, _JPEG_END = b"\xff\xd8\xff", 0xD9
_JPEG_MARKER = re.compile(rb"\xff[^\x00\x01\xd0-\xd7\xff]")  # what a scan holds (zero, restarts) is none
# TIFF 6.0, section 2, and BigTIFF, by how they begin: byte order; where it is said where the first directory
# is, and as what; as what how many entries that has; bytes of one, and before its value.
_TIFFS = {
    b"II*\0": ("<", 4, "I", "H", 12, 8),
    b"MM\0*": (">", 4, "I", "H", 12, 8),
    b"II+\0": ("<", 8, "Q", "Q", 20, 12),
    b"MM\0+": (">", 8, "Q", "Q", 20, 12),
}
_ORIENTATION = 274
_PNG_START, _PNG_END = b"\x89PNG\r\n\x1a\n", b"IEND\xaeB`\x82"


def decode(data: bytes) -> U8 | str:
    """Grey (h, w) or BGR (h, w, 3) image of an encoded one, or the reason why there is none.

    Pixels of 16 bits become 8.

    A JPEG that was cut short decodes without complaint in some versions of OpenCV, its rest grey; so
    its end marker is looked for, from segment to segment and scan to scan: inside a scan it can't occur,
    and what a segment holds (a thumbnail) or follows the end (a phone's video) may be anything. A PNG
    ends with its IEND chunk. What is damaged in the middle shows as a failing checksum (PNG); in a JPEG
    it can't be told from a picture.
    """
    return as_8_bits(_decoded(data), 16)


def as_8_bits(pixels: U8 | U16 | str, bits: int) -> U8 | str:
    """Pixels of which deeper ones make use of ``bits``; a reason stays as it is."""
    if isinstance(pixels, str):
        return pixels
    upper = np.minimum(pixels >> (bits - 8), 255) if pixels.dtype == np.uint16 else pixels
    return upper.astype(np.uint8, copy=False)


def bits_used(paths: Sequence[Path]) -> int:
    """How many bits the pixels of these images make use of; 16 where none can be read or is deeper than 8."""
    images = (read_pixels(path) for path in paths)
    deep = [image for image in images if not isinstance(image, str) and image.dtype == np.uint16]
    return next(bits for bits in _BITS if max(image.max() for image in deep) < 1 << bits) if deep else 16


def _decoded(data: bytes) -> U8 | U16 | str:
    if not data:
        return "is empty"
    if data.startswith(_JPEG_START) and not _jpeg_ends(data):
        return "is a truncated JPEG"
    if data.startswith(_PNG_START) and data.rfind(_PNG_END) < 0:
        return "is a truncated PNG"
    try:
        pixels = cv2.imdecode(np.frombuffer(as_stored(data), dtype=np.uint8), _FLAGS)
    except cv2.error:
        pixels = None
    if pixels is not None and pixels.dtype == np.int16:  # some TIFFs
        pixels = np.maximum(pixels, 0).astype(np.uint16)
    if pixels is None or pixels.dtype not in (np.uint8, np.uint16) or pixels.ndim not in (2, 3):
        return "is damaged, or no image"
    return pixels


def as_stored(data: bytes) -> bytes:
    """An encoded image as one that asks for no turn: OpenCV turns TIFFs whatever it is told."""
    layout = _TIFFS.get(data[:4])
    if layout is None:
        return data
    order, place, offset, length, entry, before = layout
    with contextlib.suppress(struct.error, OverflowError):
        (start,) = struct.unpack_from(f"{order}{offset}", data, place)
        (entries,) = struct.unpack_from(f"{order}{length}", data, start)
        start += struct.calcsize(f"={length}")
        for at in range(start, min(start + entry * entries, len(data)), entry):
            if struct.unpack_from(f"{order}H", data, at)[0] == _ORIENTATION:
                value = at + before
                return data[:value] + struct.pack(f"{order}H", 1) + data[value + 2 :]
    return data


def read_as_stored(path: Path, flags: int) -> NDArray[Any] | None:
    """As ``cv2.imread``, but never turned; None for what can't be read or is no image."""
    try:
        data = np.frombuffer(as_stored(path.read_bytes()), np.uint8)
        return cv2.imdecode(data, flags | cv2.IMREAD_IGNORE_ORIENTATION) if len(data) else None
    except (OSError, cv2.error):
        return None


def _jpeg_ends(data: bytes) -> bool:
    at = 2
    while (marker := _JPEG_MARKER.search(data, at)) is not None:
        at = marker.end()
        if data[at - 1] == _JPEG_END:
            return True
        at += int.from_bytes(data[at : at + 2], "big")  # the segment; a scan's data follow it
    return False


def read_image(path: Path) -> U8 | str:
    """The image in a file as :func:`decode` has it, or a line that names the file and says what is wrong."""
    return as_8_bits(read_pixels(path), 16)


def read_pixels(path: Path) -> U8 | U16 | str:
    """As :func:`read_image`, as deep as the file has them."""
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        return f"{path} is missing"
    except OSError as error:
        return f"{path} can't be read ({error.strerror})"
    with native_stderr_unheard():
        pixels = _decoded(data)
    return f"{path} {pixels}" if isinstance(pixels, str) else pixels


def ask_for(path: Path) -> None:
    """Have a file brought into memory meanwhile; no more than a hint, so what can't be opened is no error."""
    if not hasattr(os, "posix_fadvise"):  # macOS
        return
    with contextlib.suppress(OSError):
        file = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
        try:
            os.posix_fadvise(file, 0, 0, os.POSIX_FADV_WILLNEED)
        finally:
            os.close(file)
