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


@pytest.mark.parametrize("orientation", [3, 6])
def test_it_is_as_stored_whatever_its_file_says_of_how_the_camera_was_held(
    orientation: int, tmp_path: Path
) -> None:
    """As images are: a frame that was painted over keeps what its camera noted."""
    pixels = np.full((40, 60), 255, np.uint8)
    pixels[25:] = 0
    data = cv2.imencode(".jpg", pixels)[1].tobytes()
    tiff = b"MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0" + bytes([orientation]) + b"\0\0" + bytes(4)
    exif = b"Exif\0\0" + tiff
    path = tmp_path / "mask.jpg"
    path.write_bytes(data[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif + data[2:])
    turned = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    assert turned is not None
    assert turned.shape != pixels.shape or turned[0, 0] < 128, "it does say so"
    shown = mask_for(path, 60, 40)
    assert shown[:20].all()
    assert not shown[30:].any()


def test_a_mask_is_for_images_of_its_size(tmp_path: Path) -> None:
    mask = write(tmp_path / "mask.png", np.full((40, 60), 255, np.uint8))
    with pytest.raises(ConfigError, match=r"mask\.png is 60x40, but the camera's images are 40x60"):
        mask_for(mask, 40, 60)


def test_what_was_erased_is_neither_black_nor_white(tmp_path: Path) -> None:
    """It keeps its colour in the file, and would be shown."""
    pixels = np.full((48, 64, 4), 255, np.uint8)
    assert read_mask(write(tmp_path / "opaque.png", pixels)).all()
    pixels[40:, :, 3] = 0
    with pytest.raises(ConfigError, match=r"erased\.png is transparent in parts"):
        read_mask(write(tmp_path / "erased.png", pixels))


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
