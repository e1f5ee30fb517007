"""The images that parity is checked on, as a network sees them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from prism_edge.errors import ModelError
from prism_edge.sources.base import Image
from prism_edge.sources.sim import SimSource

MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # ImageNet's
_KINDS = {".jpg", ".jpeg", ".png"}


def pictures(given: list[Path], count: int) -> list[np.ndarray]:
    """``count`` RGB images (h, w, 3) uint8 from files or folders; without any, views of a simulated room.

    Spread evenly over what is there. Raises ModelError where there are too few or one can't be read.
    """
    if not given:
        images = []
        with SimSource("sim:room?seed=1") as source:
            while (slot := source.peek()) is not None and len(images) < count:
                if slot.index % 10:
                    source.skip()
                elif isinstance(image := source.read(), Image):
                    images.append(image.pixels[:, :, ::-1])
        return images
    files = []
    for path in given:
        if not path.exists():
            raise ModelError(f"{path}: there is no such file or folder")
        inside = sorted(path.iterdir()) if path.is_dir() else [path]
        files += [file for file in inside if not path.is_dir() or _is_colour_image(file)]
    if len(files) < count:
        raise ModelError(f"{given[0]}: {count} images are needed to check the export, {len(files)} are there")
    chosen = [files[round(i * (len(files) - 1) / max(1, count - 1))] for i in range(count)]
    return [_read(file) for file in chosen]


def tensor(image: np.ndarray, height: int, width: int) -> Tensor:
    """(1, 3, height, width) of an RGB image, stretched to the size and normalised."""
    resized = cv2.resize(image.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA) / 255.0
    normalised = (resized - np.array(MEAN, np.float32)) / np.array(STD, np.float32)
    return torch.from_numpy(np.ascontiguousarray(normalised.transpose(2, 0, 1)[None], np.float32))


def _is_colour_image(file: Path) -> bool:
    return file.suffix.lower() in _KINDS and ".depth." not in file.name


def _read(file: Path) -> np.ndarray:
    image = cv2.imread(str(file), cv2.IMREAD_COLOR)
    if image is None:
        raise ModelError(f"{file}: can't be read as an image")
    return np.asarray(image[:, :, ::-1])
