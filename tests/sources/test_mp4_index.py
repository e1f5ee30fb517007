"""Films whose index is there, not yet or no longer, as files that OpenCV writes and as their boxes alone."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from prism_edge.errors import ConfigError, SourceError
from prism_edge.sources.mp4_index import lacks_index, shown_ns
from tests.sources import tiny_datasets as tiny
from tests.sources.opening import opened

FTYP = b"isom\0\0\2\0isomiso2"


def box(kind: bytes, body: bytes = b"") -> bytes:
    return struct.pack(">I4s", 8 + len(body), kind) + body


def long_box(kind: bytes, body: bytes = b"") -> bytes:
    return struct.pack(">I4sQ", 1, kind, 16 + len(body)) + body


@pytest.mark.parametrize(
    ("content", "lacks"),
    [
        (box(b"ftyp", FTYP) + box(b"moov", b"index") + box(b"mdat", b"pictures"), False),
        (box(b"ftyp", FTYP) + long_box(b"mdat", b"pictures") + box(b"moov", b"index"), False),
        (box(b"ftyp", FTYP) + box(b"free") + box(b"mdat", b"pictures"), True),
        (box(b"ftyp", FTYP) + long_box(b"mdat", b"pictures"), True),
        (box(b"ftyp", FTYP) + struct.pack(">I4s", 0, b"mdat") + b"pictures", True),
        (box(b"ftyp", FTYP) + box(b"mdat", b"pictures")[:-3], True),
        (box(b"ftyp", FTYP) + struct.pack(">I4s", 1, b"mdat"), True),
        (box(b"ftyp", FTYP) + box(b"mdat") + box(b"moov", b"index")[:-2], True),
        (box(b"ftyp", FTYP), True),
        (box(b"moov", b"index"), False),
        (b"RIFF\x10\0\0\0AVI LIST", False),
        (b"", False),
    ],
)
def test_a_film_without_its_index_is_known_by_its_boxes(
    content: bytes, lacks: bool, tmp_path: Path
) -> None:
    file = tmp_path / "clip.mp4"
    file.write_bytes(content)
    assert lacks_index(file) is lacks


def test_what_is_not_there_lacks_nothing(tmp_path: Path) -> None:
    assert not lacks_index(tmp_path / "none.mp4")
    assert shown_ns(tmp_path / "none.mp4") == 0


SHORT = struct.pack(">B11xII80x", 0, 600, 1500)
LONG = struct.pack(">B19xIQ80x", 1, 90_000, 5 << 32)


@pytest.mark.parametrize(
    ("content", "seconds"),
    [
        (box(b"ftyp", FTYP) + box(b"moov", box(b"mvhd", SHORT)), 2.5),
        (long_box(b"mdat", b"x") + box(b"moov", box(b"free") + box(b"mvhd", SHORT)), 2.5),
        (box(b"moov", box(b"mvhd", LONG)), (5 << 32) / 90_000),
        (box(b"ftyp", FTYP) + box(b"moov", box(b"trak")) + box(b"mvhd", SHORT), 0),
        (box(b"moov", box(b"mvhd", SHORT[:19])), 0),
        (box(b"moov", box(b"mvhd", b"\2" + SHORT[1:])), 0),
        (box(b"moov", box(b"mvhd", struct.pack(">B11xII80x", 0, 0, 1500))), 0),
        (box(b"moov", box(b"mvhd", struct.pack(">B11xII80x", 0, 600, 0xFFFFFFFF))), 0),
        (box(b"moov", struct.pack(">I4sQ", 1, b"mvhd", 2**63) + SHORT), 2.5),
        (struct.pack(">I4sQ", 1, b"moov", 2**64 - 1) + struct.pack(">I4sQ", 1, b"free", 2**64 - 1), 0),
        (box(b"moov", struct.pack(">I4sQ", 1, b"mvhd", 9) + SHORT), 0),
        (box(b"moov", struct.pack(">I4sQ", 1, b"free", 2**63) + box(b"mvhd", SHORT)), 0),
        (b"RIFF\x10\0\0\0AVI LIST", 0),
        (b"", 0),
    ],
)
def test_how_long_a_film_is_shown(content: bytes, seconds: float, tmp_path: Path) -> None:
    file = tmp_path / "clip.mp4"
    file.write_bytes(content)
    assert shown_ns(file) == round(1e9 * seconds)


@given(st.binary(max_size=60))
def test_any_bytes_have_an_answer(tmp_path_factory: pytest.TempPathFactory, tail: bytes) -> None:
    file = tmp_path_factory.getbasetemp() / "any.mp4"
    file.write_bytes(box(b"ftyp", FTYP) + tail)
    assert lacks_index(file) in (True, False)
    assert shown_ns(file) == 0
    file.write_bytes(box(b"moov", tail))
    assert shown_ns(file) >= 0
    file.write_bytes(tail)
    assert lacks_index(file) is tail[4:8].startswith(b"ftyp")


def test_a_recording_that_was_cut_off_says_so(tmp_path: Path) -> None:
    film = tiny.write_video(tmp_path / "clip.mp4", kind="mp4v")
    with opened(film) as source:
        assert source.read() is not None
    tiny.truncate(film)
    with pytest.raises((SourceError, ConfigError), match=r"has no index \(moov\)"):
        opened(film).open()
    film.write_bytes(b"no film")
    with pytest.raises(SourceError, match="no video that can be read"):
        opened(film).open()
