"""Reading one image file, and telling a whole one from one that was cut short."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

import cv2
import numpy as np

from prism_edge.messages import U8

SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".pgm", ".ppm", ".tif", ".tiff", ".webp")

# Grey stays grey, deeper pixels become 8 bits, alpha goes; intrinsics belong to the image as stored,
# so a rotation that the file asks for is not made.
_FLAGS = cv2.IMREAD_ANYCOLOR | cv2.IMREAD_IGNORE_ORIENTATION

_JPEG_START, _JPEG_SCAN, _JPEG_END = b"\xff\xd8\xff", b"\xff\xda", b"\xff\xd9"
_PNG_START, _PNG_END = b"\x89PNG\r\n\x1a\n", b"IEND\xaeB`\x82"


def decode(data: bytes) -> U8 | str:
    """Grey (h, w) or BGR (h, w, 3) image of an encoded one, or the reason why there is none.

    A JPEG that was cut short decodes without complaint in some versions of OpenCV, its rest grey; so
    its end marker is looked for, behind the last scan: inside a scan the marker can't occur, as every
    0xff there is followed by zero or a restart. A PNG ends with its IEND chunk. What is damaged in
    the middle shows as a failing checksum (PNG); in a JPEG it can't be told from a picture.
    """
    if not data:
        return "is empty"
    if data.startswith(_JPEG_START) and data.rfind(_JPEG_END, max(data.rfind(_JPEG_SCAN), 0)) < 0:
        return "is a truncated JPEG"
    if data.startswith(_PNG_START) and data.rfind(_PNG_END) < 0:
        return "is a truncated PNG"
    try:
        pixels = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), _FLAGS)
    except cv2.error:
        pixels = None
    if pixels is None or pixels.dtype != np.uint8 or pixels.ndim not in (2, 3):
        return "is damaged, or no image"
    return pixels


def read_image(path: Path) -> U8 | str:
    """The image in a file, or a line that names the file and says what is wrong with it."""
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        return f"{path} is missing"
    except OSError as error:
        return f"{path} can't be read ({error.strerror})"
    pixels = decode(data)
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
