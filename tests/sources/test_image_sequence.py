"""A recording's images are asked for before their time comes."""

from __future__ import annotations

import ctypes
import mmap
import os
from pathlib import Path

import numpy as np
import pytest

from prism_edge.config import SourceConfig
from prism_edge.errors import SourceError
from prism_edge.sources import Image, Unreadable, open_source
from prism_edge.sources import image_sequence as module
from prism_edge.sources.base import DEFAULT_RATE_HZ
from prism_edge.sources.checks import FrameChecks
from prism_edge.sources.image_file import ask_for
from tests.sources.tiny_datasets import CAMERA, picture, write_image, write_tum
from tests.waiting import until

needs_hints = pytest.mark.skipif(not hasattr(os, "posix_fadvise"), reason="no hints to the system here")


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of the files that were asked for, in order."""
    names: list[str] = []
    monkeypatch.setattr(module, "ask_for", lambda path: names.append(path.name))
    return names


def test_each_image_is_asked_for_once_and_early(
    tmp_path: Path, asked: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "AHEAD", 3)
    with open_source(SourceConfig(str(write_tum(tmp_path, count=8)))) as source:
        for k in range(8):
            source.read_ahead()
            source.read_ahead()
            assert len(asked) == min(k + 3, 8)
            source.read()
        source.read_ahead()
    assert asked == sorted(asked)
    assert len(set(asked)) == 8


@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
def test_pixels_deeper_than_8_bits_have_one_range_for_all(
    tmp_path: Path, bits: int, caplog: pytest.LogCaptureFixture
) -> None:
    """Most cameras of 12 bits store them as they are in files of 16; the first image may be a dark one."""
    (tmp_path / "camera.yaml").write_text(CAMERA)
    shades = [picture(k, colour=False) // (8 if k < 3 else 1) for k in range(30)]
    for k, grey in enumerate(shades):
        write_image(tmp_path / f"{k}.png", grey.astype(np.uint16) << (bits - 8))
    with open_source(SourceConfig(str(tmp_path))) as source:
        items = list(iter(source.read, None))
    for item, grey in zip(items, shades, strict=True):
        assert isinstance(item, Image)
        np.testing.assert_array_equal(item.pixels, grey)
    assert caplog.text.count(f"its pixels use {bits} bits") == 1


def test_a_few_images_deeper_than_8_bits_have_the_range_that_they_use(tmp_path: Path) -> None:
    """Fewer than are judged of a long recording."""
    (tmp_path / "camera.yaml").write_text(CAMERA)
    grey = picture(5, colour=False)
    for k in range(2):
        write_image(tmp_path / f"{k}.png", grey.astype(np.uint16) << 4)
    with open_source(SourceConfig(str(tmp_path))) as source:
        item = source.read()
    assert isinstance(item, Image)
    np.testing.assert_array_equal(item.pixels, grey)


def test_images_deeper_than_8_bits_after_one_of_8_have_the_range_that_they_use(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "camera.yaml").write_text(CAMERA)
    greys = [picture(k, colour=False) for k in range(5)]
    for k, grey in enumerate(greys):
        write_image(tmp_path / f"{k}.png", grey.astype(np.uint16) << 4 if k else grey)
    with open_source(SourceConfig(str(tmp_path))) as source:
        items = list(iter(source.read, None))
    for item, grey in zip(items, greys, strict=True):
        assert isinstance(item, Image)
        np.testing.assert_array_equal(item.pixels, grey)
    assert caplog.text.count("its pixels use 12 bits") == 1


def test_one_image_alone_is_played_again_at_the_usual_rate(tmp_path: Path) -> None:
    with open_source(SourceConfig(str(write_tum(tmp_path, count=1)), loop=True)) as source:
        stamps = [item.stamp_ns for item in (source.read() for _ in range(3)) if item]
    assert np.diff(stamps).tolist() == [round(1e9 / DEFAULT_RATE_HZ)] * 2


def test_what_is_skipped_is_not_asked_for(
    tmp_path: Path, asked: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "AHEAD", 2)
    with open_source(SourceConfig(str(write_tum(tmp_path, count=8)))) as source:
        source.read_ahead()
        for _ in range(5):
            assert source.peek() is not None
            source.skip()
        source.read_ahead()
    assert len(asked) == 4  # the first two, the sixth and the seventh


def test_a_looped_recording_asks_too(tmp_path: Path, asked: list[str]) -> None:
    with open_source(SourceConfig(str(write_tum(tmp_path, count=8)), loop=True)) as source:
        source.read_ahead()
        assert len(asked) == 8


@needs_hints
def test_a_file_comes_into_memory(tmp_path: Path) -> None:
    file = tmp_path / "image"
    file.write_bytes(bytes(200_000))
    handle = os.open(file, os.O_RDWR)
    os.fsync(handle)
    os.posix_fadvise(handle, 0, 0, os.POSIX_FADV_DONTNEED)
    os.close(handle)
    if in_memory(file):
        pytest.skip("files of this folder stay in memory")

    def asked() -> bool:
        ask_for(file)  # again and again: a busy system may pass over a hint, or take the pages away
        return in_memory(file)

    until(asked, deadline_s=10.0)


def in_memory(file: Path) -> bool:
    """Whether all pages of a file are there, asked without a read, which would fetch them."""
    with file.open("rb") as opened, mmap.mmap(opened.fileno(), 0, access=mmap.ACCESS_COPY) as pages:
        there = (ctypes.c_ubyte * -(-len(pages) // mmap.PAGESIZE))()
        first = ctypes.c_char.from_buffer(pages)
        size = ctypes.c_size_t(len(pages))
        failed = ctypes.CDLL(None, use_errno=True).mincore(ctypes.byref(first), size, there)
        del first  # or the file could not be let go
        assert not failed, os.strerror(ctypes.get_errno())
        return all(page & 1 for page in there)


@needs_hints
def test_what_can_not_be_opened_is_no_error(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for name in ("missing", ".", "pipe"):
        ask_for(tmp_path / name)


def test_a_recording_none_of_whose_stamps_can_be_published_is_an_error(tmp_path: Path) -> None:
    folder = write_tum(tmp_path)
    table = folder / "rgb.txt"
    rows = [line for line in table.read_text().splitlines() if not line.startswith("#")]
    names = [row.split()[1] for row in rows]
    table.write_text("".join(f"{4000000000 + i}.5 {name}\n" for i, name in enumerate(names)))
    with pytest.raises(SourceError, match=r"no ROS message can hold its stamps, such as 4000000000\.5"):
        open_source(SourceConfig(str(folder))).open()
    table.write_text("".join(f"{4000000000 * (i > 0) + i}.5 {name}\n" for i, name in enumerate(names)))
    with open_source(SourceConfig(str(folder))) as source:
        assert source.read() is not None


@pytest.mark.parametrize("looped", [False, True])
def test_a_stamp_that_leaps_ahead_costs_one_image(
    tmp_path: Path, looped: bool, caplog: pytest.LogCaptureFixture
) -> None:
    """And what plays it again and again goes on one period after the last, not an hour."""
    folder = write_tum(tmp_path, count=5)
    rows = [line for line in (folder / "rgb.txt").read_text().splitlines() if not line.startswith("#")]
    stamps = [float(row.split()[0]) for row in rows]
    for leap in (0, 2):
        table = list(rows)
        table[leap] = f"{stamps[leap] + 7200:.6f} {rows[leap].split()[1]}"
        (folder / "rgb.txt").write_text("\n".join(table))
        caplog.clear()
        with open_source(SourceConfig(str(folder), loop=looped)) as source:
            checks, released = FrameChecks(source.camera), []
            for k in range(15 if looped else 5):
                slot, item = source.peek(), source.read()
                assert slot is not None
                assert isinstance(item, Image | Unreadable)
                assert (slot.index, slot.stamp_ns) == (item.index, item.stamp_ns)
                assert checks.refuses(slot) == (k % 5 == leap)
                if checks.check(item).released:
                    released.append(item.index)
        assert released == [k for k in range(15 if looped else 5) if k % 5 != leap]
        assert checks.counts.bad_stamps == checks.counts.frames // 5
        assert checks.counts.unreadable == 0
        assert f"can't be right beside the others: 1, of image {leap} first; left out" in caplog.text
        assert caplog.text.count("left out") == 1, "in each round of a loop it is opened again"
        if looped:
            assert item.stamp_ns < 10e9 + 1e9 * stamps[-1]


def test_a_link_that_leads_nowhere_is_an_image_that_is_missing(tmp_path: Path) -> None:
    (tmp_path / "camera.yaml").write_text(CAMERA)
    for k in range(10):
        if k in (3, 4):
            (tmp_path / f"{k}.png").symlink_to("not fetched")
        else:
            write_image(tmp_path / f"{k}.png", picture(k))
    with open_source(SourceConfig(str(tmp_path))) as source:
        items = list(iter(source.read, None))
    assert [item.index for item in items] == list(range(10))
    assert [k for k, item in enumerate(items) if isinstance(item, Unreadable)] == [3, 4]
    assert "is missing" in items[3].reason


def test_libraries_have_no_line_of_their_own_for_each_picture(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "camera.yaml").write_text(CAMERA)
    write_image(tmp_path / "0.png", picture(0))
    data = bytearray((tmp_path / "0.png").read_bytes())
    data[len(data) // 2] ^= 0xFF
    (tmp_path / "1.png").write_bytes(data)
    with open_source(SourceConfig(str(tmp_path))) as source:
        items = list(iter(source.read, None))
    assert isinstance(items[1], Unreadable)
    assert "libpng" not in capfd.readouterr().err
