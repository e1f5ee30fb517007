"""Telling whole images from truncated ones."""

from __future__ import annotations

import re
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sources import tiny_datasets as tiny
from sources.tiny_datasets import picture

from prism_edge.sources.image_file import as_8_bits, decode, read_as_stored, read_image
from prism_edge.sources.sensor_depth import SensorDepth

STARTS = [b"", b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n", b"BM", b"P6\n", b"II*\0", b"MM\0*\0\0\0\10", b"II+\0"]


def encoded(suffix: str, image: np.ndarray, *settings: int) -> bytes:
    done, data = cv2.imencode(suffix, image, list(settings))
    assert done
    return data.tobytes()


@pytest.mark.parametrize("suffix", [".png", ".bmp", ".ppm", ".tiff"])
@pytest.mark.parametrize("colour", [True, False])
def test_lossless_formats_come_back_as_they_were(suffix: str, colour: bool) -> None:
    image = picture(3, colour=colour)
    if suffix == ".ppm" and not colour:
        suffix = ".pgm"
    np.testing.assert_array_equal(decode(encoded(suffix, image)), image)


@pytest.mark.parametrize("colour", [True, False])
@pytest.mark.parametrize("progressive", [0, 1])
def test_jpeg_comes_back_nearly(colour: bool, progressive: int) -> None:
    image = picture(4, colour=colour)
    data = encoded(".jpg", image, cv2.IMWRITE_JPEG_QUALITY, 95, cv2.IMWRITE_JPEG_PROGRESSIVE, progressive)
    pixels = decode(data)
    assert not isinstance(pixels, str)
    assert pixels.shape == image.shape
    assert np.abs(pixels.astype(int) - image).mean() < 5


def test_deep_and_transparent_images_become_plain_ones() -> None:
    grey = picture(5, colour=False)
    deep = decode(encoded(".png", grey.astype(np.uint16) * 257))
    np.testing.assert_array_equal(deep, grey)
    np.testing.assert_array_equal(as_8_bits(grey.astype(np.uint16) << 4, 12), grey)
    beyond = as_8_bits(grey.astype(np.uint16) << 6, 12)  # brighter than what was looked at
    np.testing.assert_array_equal(beyond, np.minimum(grey.astype(int) * 4, 255))
    image = picture(5)
    alpha = np.dstack([image, np.full(image.shape[:2], 255, np.uint8)])
    np.testing.assert_array_equal(decode(encoded(".png", alpha)), image)


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
@settings(max_examples=60, deadline=None)
@given(share=st.floats(0.0, 0.999))
def test_a_file_cut_anywhere_is_no_image(suffix: str, share: float) -> None:
    data = encoded(suffix, picture(6, 160, 120))
    # the two bytes of the end marker, or the checksum of the last chunk, are the least that is missing
    assert isinstance(decode(data[: min(int(len(data) * share), len(data) - 2)]), str)


def test_a_progressive_jpeg_cut_after_a_scan_is_truncated() -> None:
    data = encoded(".jpg", picture(6, 160, 120), cv2.IMWRITE_JPEG_PROGRESSIVE, 1)
    last_scan = data.rfind(b"\xff\xda")
    assert data.count(b"\xff\xda") > 1
    assert "truncated" in str(decode(data[:last_scan]))


def test_an_end_marker_in_a_thumbnail_does_not_count() -> None:
    data = encoded(".jpg", picture(6, 160, 120))
    thumbnail = encoded(".jpg", picture(7, 16, 12))
    segment = b"\xff\xe1" + (len(thumbnail) + 2).to_bytes(2, "big") + thumbnail
    whole = data[:2] + segment + data[2:]
    assert not isinstance(decode(whole), str)
    assert "truncated" in str(decode(whole[: len(whole) - 200]))


def test_bytes_behind_the_end_are_allowed() -> None:
    """A phone's video behind its picture, in which a scan seems to begin, too."""
    for suffix in (".jpg", ".png"):
        for more in (b"\0" * 100, b"ftyp\xff\xda and so on"):
            assert not isinstance(decode(encoded(suffix, picture(8)) + more), str)


def test_restarts_within_a_scan_are_no_segments() -> None:
    """A length read from what follows them would lead past the end."""
    data = encoded(".jpg", picture(6, 160, 120), cv2.IMWRITE_JPEG_RST_INTERVAL, 2)
    assert len(re.findall(rb"\xff[\xd0-\xd7]", data)) > 5
    assert not isinstance(decode(data), str)
    assert "truncated" in str(decode(data[:-2]))


def test_a_png_damaged_in_the_middle_fails_its_checksum() -> None:
    data = bytearray(encoded(".png", picture(9, 160, 120)))
    data[len(data) // 2] ^= 0xFF
    assert isinstance(decode(bytes(data)), str)


@settings(max_examples=60, deadline=None)
@given(st.binary(max_size=200), st.sampled_from(STARTS))
def test_any_bytes_are_an_image_or_a_reason(data: bytes, start: bytes) -> None:
    result = decode(start + data)
    assert isinstance(result, str) or result.dtype == np.uint8


def test_a_header_that_promises_too_much_is_refused() -> None:
    data = encoded(".png", picture(1))
    header = b"IHDR" + (2**30).to_bytes(4, "big") + (2**30).to_bytes(4, "big") + data[24:29]
    huge = data[:12] + header + zlib.crc32(header).to_bytes(4, "big") + data[33:]
    assert isinstance(decode(huge), str)


def test_reasons_name_the_file(tmp_path: Path) -> None:
    for path in (tmp_path / "none.png", tmp_path):
        reason = read_image(path)
        assert isinstance(reason, str)
        assert str(path) in reason


def test_signed_pixels_are_what_they_are_from_zero_up() -> None:
    grey = np.linspace(0, 32000, 64 * 48).reshape(48, 64).astype(np.int16)
    signed, plain = decode(encoded(".tiff", grey)), decode(encoded(".tiff", grey.astype(np.uint16)))
    np.testing.assert_array_equal(signed, plain)


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("big", [False, True])
def test_a_tiff_that_asks_to_be_turned_is_taken_as_it_is_stored(
    order: str, orientation: int, big: bool, tmp_path: Path
) -> None:
    image = picture(3, colour=False)
    data = (big_tiff if big else tiff)(order, image, orientation)
    np.testing.assert_array_equal(decode(data), image)
    (tmp_path / "depth.tif").write_bytes(data)
    np.testing.assert_array_equal(read_as_stored(tmp_path / "depth.tif", cv2.IMREAD_UNCHANGED), image)


def test_depth_images_are_taken_as_they_are_stored_too(tmp_path: Path) -> None:
    """A sensor's go with the colour images pixel for pixel."""
    folder, shown = tiny.write_tum(tmp_path / "tum", count=1), picture(3, colour=False)
    stamp = (folder / "rgb.txt").read_text().split()[-2]
    (folder / "depth.txt").write_text(f"{stamp} depth.tif\n")
    (folder / "depth.tif").write_bytes(tiff("<", shown, orientation=3, deep=True))
    depth = SensorDepth(folder).read(0)
    assert depth is not None
    np.testing.assert_allclose(depth, 257 * shown.astype(float) / 5000.0, rtol=1e-6)


def test_what_is_no_image_is_none_to_who_reads_it_as_stored(tmp_path: Path) -> None:
    for content in (None, b"", b"II+\0" + b"\xff" * 20, b"none"):
        if content is not None:
            (tmp_path / "x.tif").write_bytes(content)
        assert read_as_stored(tmp_path / "x.tif", cv2.IMREAD_UNCHANGED) is None


def tiff(order: str, grey: np.ndarray, orientation: int, deep: bool = False) -> bytes:
    """The least of an uncompressed TIFF (6.0, section 4): header, pixels, and nine entries of one value."""
    (height, width), pixels = grey.shape, np.repeat(grey, 2).tobytes() if deep else grey.tobytes()
    tags = {256: width, 257: height, 258: 8, 259: 1, 262: 1, 273: 8, 274: orientation, 278: height}
    tags[258] *= 1 + deep
    entries = [(tag, 4, 1, value) if tag == 273 else (tag, 3, 1, value) for tag, value in tags.items()]
    entries.append((279, 4, 1, len(pixels)))
    packed = [
        struct.pack(f"{order}HHI", *entry[:3])
        + (struct.pack(f"{order}I", entry[3]) if entry[1] == 4 else struct.pack(f"{order}HH", entry[3], 0))
        for entry in entries
    ]
    start = b"II*\0" if order == "<" else b"MM\0*"
    directory = struct.pack(f"{order}H", len(packed)) + b"".join(packed) + bytes(4)
    return start + struct.pack(f"{order}I", 8 + len(pixels)) + pixels + directory


def big_tiff(order: str, grey: np.ndarray, orientation: int) -> bytes:
    """The same as BigTIFF: eight bytes wherever it says a place or a number of things."""
    (height, width), pixels = grey.shape, grey.tobytes()
    tags = {256: width, 257: height, 258: 8, 259: 1, 262: 1, 274: orientation, 278: height}
    entries = [struct.pack(f"{order}HHQH6x", tag, 3, 1, value) for tag, value in tags.items()]
    entries.append(struct.pack(f"{order}HHQQ", 273, 16, 1, 16))
    entries.append(struct.pack(f"{order}HHQQ", 279, 16, 1, len(pixels)))
    entries.sort(key=lambda entry: struct.unpack_from(f"{order}H", entry))
    start = (b"II" if order == "<" else b"MM") + struct.pack(f"{order}HHHQ", 43, 8, 0, 16 + len(pixels))
    return start + pixels + struct.pack(f"{order}Q", len(entries)) + b"".join(entries) + bytes(8)
