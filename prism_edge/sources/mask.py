"""Masks: which part of every image shows the world, and which the robot itself or writing laid over it."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from prism_edge.errors import ConfigError
from prism_edge.named_path import refuse_pipe
from prism_edge.sources.image_file import as_stored
from prism_edge.sources.shrunk import shrunk

Shown = NDArray[np.bool_]  # (height, width): True where the world is seen

LEAST_SHOWN = 0.1  # of the image: with less there is hardly a map to be made


def read_mask(path: Path, shrink: int = 1) -> Shown:
    """The mask that an image file holds: what is darker than half grey is not the world.

    Where images are made smaller by ``shrink``, so is the mask: a pixel shows the world if all of it does.
    Raises ConfigError, naming the file, where it is no image or leaves less than LEAST_SHOWN of it.
    """
    try:
        refuse_pipe(path)
        data = np.frombuffer(as_stored(path.read_bytes()), np.uint8)
    except OSError as error:
        raise ConfigError(f"mask {path} can't be read ({error.strerror})") from None
    try:
        # As images are: whatever a camera notes about how it was held.
        flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
        pixels = cv2.imdecode(data, flags) if len(data) else None
        whole = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if pixels is not None else None
    except cv2.error:
        pixels = whole = None
    if pixels is None:
        raise ConfigError(f"mask {path} is no image; expected one that is black where the robot is seen")
    if whole is not None and whole.ndim == 3 and whole.shape[2] == 4 and np.ptp(whole[..., 3]):
        # What was erased still has its colour, and what is painted on a layer has none beside it.
        raise ConfigError(f"mask {path} is transparent in parts; paint all of it, black or white")
    shown: Shown = np.asarray(pixels) >= 128
    if shown.mean() < LEAST_SHOWN:
        raise ConfigError(
            f"mask {path} leaves {100.0 * shown.mean():.0f} % of the image; "
            "white is what is looked at, black what is not"
        )
    return shown if shrink == 1 else shrunk(shown.astype(np.uint8) * np.uint8(255), shrink) == 255


def mask_for(path: Path, width: int, height: int, shrink: int = 1, hint: str = "") -> Shown:
    """:func:`read_mask` for images of one size. Raises ConfigError, too, ``hint`` behind, for another."""
    shown = read_mask(path, shrink)
    if shown.shape != (height, width):
        size = f"{shown.shape[1]}x{shown.shape[0]}" + (f" after source.shrink {shrink}" if shrink > 1 else "")
        raise ConfigError(f"mask {path} is {size}, but the camera's images are {width}x{height}{hint}")
    return shown
