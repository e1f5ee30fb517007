"""Masks from image files: what they hide, and files that are none."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from prism_edge.errors import ConfigError
from prism_edge.sources.mask import mask_for, read_mask


def write(path: Path, pixels: np.ndarray) -> Path:
    assert cv2.imwrite(str(path), pixels)
    return path


@pytest.mark.parametrize("colour", [False, True])
def test_black_is_hidden_and_white_is_shown(colour: bool, tmp_path: Path) -> None:
    pixels = np.full((40, 60), 255, np.uint8)
    pixels[30:, 10:50] = 0
    pixels[0, :2] = (127, 128)  # where one becomes the other
    drawn = cv2.cvtColor(pixels, cv2.COLOR_GRAY2BGR) if colour else pixels
    shown = mask_for(write(tmp_path / "mask.png", drawn), 60, 40)
    assert shown.shape == (40, 60)
    assert not shown[30:, 10:50].any()
    assert not shown[0, 0]
    assert np.count_nonzero(~shown) == 10 * 40 + 1


def test_a_mask_is_for_images_of_its_size(tmp_path: Path) -> None:
    mask = write(tmp_path / "mask.png", np.full((40, 60), 255, np.uint8))
    with pytest.raises(ConfigError, match=r"mask\.png is 60x40, but the camera's images are 40x60"):
        mask_for(mask, 40, 60)


@pytest.mark.parametrize("data", [b"", b"no image at all", b"\x89PNG\r\n\x1a\n" + bytes(20)])
def test_what_is_no_image_is_refused(data: bytes, tmp_path: Path) -> None:
    (tmp_path / "mask.png").write_bytes(data)
    with pytest.raises(ConfigError, match=r"mask\.png is no image"):
        read_mask(tmp_path / "mask.png")


def test_what_is_not_there_or_no_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="can't be read"):
        read_mask(tmp_path / "nothing.png")
    with pytest.raises(ConfigError, match="can't be read"):
        read_mask(tmp_path)


def test_a_mask_that_leaves_hardly_anything_is_refused(tmp_path: Path) -> None:
    pixels = np.zeros((40, 60), np.uint8)
    pixels[:3] = 255
    with pytest.raises(ConfigError, match="leaves 8 % of the image; white is what is looked at"):
        read_mask(write(tmp_path / "mask.png", pixels))


def test_a_pipe_is_refused_before_anybody_waits_for_it(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "mask.png")
    with pytest.raises(ConfigError, match=r"mask .*mask\.png can't be read \(a pipe, not a file\)"):
        read_mask(tmp_path / "mask.png")
