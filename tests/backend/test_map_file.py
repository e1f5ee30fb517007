"""The layout of stored maps: what is written comes back, and nothing else is taken for a map."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from prism_edge.backend import map_file
from prism_edge.errors import MapError

ARRAYS = {
    "ids": np.arange(5, dtype=np.int64),
    "poses": np.random.default_rng(0).normal(size=(5, 4, 4)),
    "pixels": np.ones((3, 2), np.float32),
    "octaves": np.array([1, 2, 3], np.uint8),
    "none": np.zeros((0, 3)),
}
INFO = {"epoch": 3, "log_scale": 0.1, "robot": "ä"}
GOOD = map_file.pack(INFO, ARRAYS)


def sealed(body: bytes) -> bytes:
    """A file whose checksum is right, whatever else is not."""
    return body + hashlib.sha256(body).digest()


def crafted(header: Any, data: bytes = b"") -> bytes:
    """A file with a header of one's own, lengths and checksum right."""
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    padded = text + bytes(-len(text) % 8) + data
    prefix = struct.pack("<8sIIQ", b"PRISMMAP", map_file.VERSION, len(text), 24 + len(padded) + 32)
    return sealed(prefix + padded)


def test_what_is_written_comes_back() -> None:
    info, arrays = map_file.unpack(GOOD)
    assert info == INFO
    assert arrays.keys() == ARRAYS.keys()
    for name, array in ARRAYS.items():
        np.testing.assert_array_equal(arrays[name], array)
        assert arrays[name].dtype == array.dtype
        assert not arrays[name].flags.writeable or arrays[name].size == 0


@given(
    hnp.arrays(
        st.sampled_from([np.int64, np.float64, np.float32, np.uint8]),
        hnp.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=4),
    )
)
@settings(max_examples=60, deadline=None)
def test_any_array_survives(array: np.ndarray) -> None:
    _, found = map_file.unpack(map_file.pack({}, {"a": array}))
    np.testing.assert_array_equal(found["a"], array)
    assert found["a"].shape == array.shape


def test_the_layout_is_as_documented() -> None:
    magic, version, header, length = struct.unpack_from("<8sIIQ", GOOD)
    assert (magic, version, length) == (b"PRISMMAP", 1, len(GOOD))
    assert json.loads(GOOD[24 : 24 + header])["info"] == INFO
    assert hashlib.sha256(GOOD[:-32]).digest() == GOOD[-32:]
    start = 24 + header + -header % 8
    np.testing.assert_array_equal(np.frombuffer(GOOD, "<i8", 5, start), ARRAYS["ids"])


@pytest.mark.parametrize("longer", range(8))
def test_a_header_of_any_length_comes_back_with_nothing_behind_it(longer: int) -> None:
    info = {"robot": "a" * longer}
    assert map_file.unpack(map_file.pack(info, {})) == (info, {})


def test_a_header_as_long_as_may_be_is_written_and_read_and_no_longer_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    (length,) = struct.unpack_from("<I", GOOD, 12)
    monkeypatch.setattr(map_file, "LARGEST_HEADER", length)
    assert map_file.unpack(map_file.pack(INFO, ARRAYS))[0] == INFO
    monkeypatch.setattr(map_file, "LARGEST_HEADER", length - 1)
    with pytest.raises(MapError, match="header"):
        map_file.pack(INFO, ARRAYS)
    with pytest.raises(MapError, match="header"):
        map_file.unpack(GOOD)


def test_what_could_not_be_read_again_is_not_written() -> None:
    with pytest.raises(MapError, match="not JSON compliant"):
        map_file.pack({"log_scale": float("nan")}, {})


def test_a_sound_file_of_another_kind_is_no_map() -> None:
    with pytest.raises(MapError, match="does not begin as a map"):
        map_file.unpack(sealed(b"PRISMMAQ" + GOOD[8:-32]))


@given(st.integers(0, len(GOOD) - 1), st.integers(1, 255))
@settings(max_examples=100, deadline=None)
def test_one_changed_byte_is_found(at: int, change: int) -> None:
    data = bytearray(GOOD)
    data[at] ^= change
    with pytest.raises(MapError):
        map_file.unpack(bytes(data))


@given(st.integers(0, len(GOOD) - 1))
@settings(max_examples=60, deadline=None)
def test_a_truncated_file_is_found(length: int) -> None:
    with pytest.raises(MapError):
        map_file.unpack(GOOD[:length])


@given(st.binary(max_size=300))
@settings(max_examples=100, deadline=None)
def test_noise_is_no_map(data: bytes) -> None:
    for tried in (data, b"PRISMMAP" + data, sealed(GOOD[:24] + data), crafted(data)):
        with pytest.raises(MapError) as caught:
            map_file.unpack(tried)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "header",
    [
        {"info": {}, "arrays": [["a", "<f8", [10**12]]]},  # more than there is
        {"info": {}, "arrays": [["a", "<f8", [2**62, 2**62]]]},
        {"info": {}, "arrays": [["a", "<f8", [0, 2**62]]]},
        {"info": {}, "arrays": [["a", "<f8", [-1]]]},
        {"info": {}, "arrays": [["a", "<f8", [1.0]]]},
        {"info": {}, "arrays": [["a", "<f8", [True]]]},
        {"info": {}, "arrays": [["a", "|O", [1]]]},  # objects
        {"info": {}, "arrays": [["a", "<U1000000", [1]]]},
        {"info": {}, "arrays": [["a", "<f8", [0]], ["a", "<f8", [0]]]},
        {"info": {}, "arrays": [["a", "<f8", [0, 0, 0, 0]]]},
        {"info": {}, "arrays": [["a", "<f8"]]},
        {"info": {}, "arrays": [5]},
        {"info": [], "arrays": []},
        {"arrays": []},
        [],
        b'{"info": {"x": NaN}, "arrays": []}',
        b"[" * 100_000,
    ],
    ids=str,
)
def test_a_crafted_header_is_refused(header: Any) -> None:
    with pytest.raises(MapError):
        map_file.unpack(crafted(header, bytes(8)))


@pytest.mark.parametrize(
    ("shapes", "size"),
    [
        ([["a", "<f8", [1]], ["a", "<f8", [1]]], 16),  # one name twice
        ([["a", "<f8", [0]], ["a", "<f8", [0]]], 0),
        ([["a", "<i4", [2]]], 8),
        ([["a", "<c16", [1]]], 16),
        ([[5, "<f8", [1]]], 8),
        ([["a", "<f8", [1, 1, 1, 1]]], 8),
        ([["a", "<f8", [True]]], 8),
        ([["a", "<f8", [4]]], 0),  # its numbers would be the checksum's
    ],
    ids=str,
)
def test_arrays_whose_bytes_are_all_there_are_refused_for_what_they_are(shapes: Any, size: int) -> None:
    with pytest.raises(MapError, match="array"):
        map_file.unpack(crafted({"info": {}, "arrays": shapes}, bytes(size)))


def test_no_map_is_written_whose_header_nobody_would_read() -> None:
    with pytest.raises(MapError, match="header"):
        map_file.pack({"robot": "a" * map_file.LARGEST_HEADER}, ARRAYS)


def test_no_map_is_written_that_would_be_refused_for_its_size(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(map_file, "LARGEST_FILE", len(GOOD))
    assert map_file.pack(INFO, ARRAYS) == GOOD
    monkeypatch.setattr(map_file, "LARGEST_FILE", len(GOOD) - 1)
    with pytest.raises(MapError, match=f"would take {len(GOOD)} bytes"):
        map_file.pack(INFO, ARRAYS)


def test_bytes_that_no_array_claims_are_refused() -> None:
    with pytest.raises(MapError, match="too many"):
        map_file.unpack(crafted({"info": {}, "arrays": []}, bytes(8)))


def test_another_version_is_named() -> None:
    body = bytearray(GOOD[:-32])
    body[8] = 9
    with pytest.raises(MapError, match="version 9, this is version 1"):
        map_file.unpack(sealed(bytes(body)))


class TestFiles:
    def test_write_and_read(self, tmp_path: Path) -> None:
        path = tmp_path / "lab.prismmap"
        for data in (GOOD, b"the next"):
            map_file.write(path, data)
            assert map_file.read(path) == data
        assert list(tmp_path.iterdir()) == [path]

    @pytest.mark.parametrize("fails", ["write", "fsync", "replace"])
    def test_a_failure_leaves_the_old_one_and_no_half(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fails: str
    ) -> None:
        path = tmp_path / "lab.prismmap"
        map_file.write(path, GOOD)

        def fail(*_: object) -> None:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

        if fails == "write":
            real = os.fdopen
            monkeypatch.setattr(
                os, "fdopen", lambda fd, mode: real(os.open("/dev/full", os.O_WRONLY), mode, closefd=True)
            )
        else:
            monkeypatch.setattr(os, fails, fail)
        with pytest.raises(MapError, match="No space left"):
            map_file.write(path, b"new" * 10_000)
        monkeypatch.undo()
        assert map_file.read(path) == GOOD
        assert list(tmp_path.iterdir()) == [path]

    def test_what_can_not_be_read_is_named(self, tmp_path: Path) -> None:
        with pytest.raises(MapError, match="No such file"):
            map_file.read(tmp_path / "none")
        with pytest.raises(MapError, match="directory"):
            map_file.read(tmp_path)
        with pytest.raises(MapError, match="is no file"):
            map_file.read(Path("/dev/zero"))
        big = tmp_path / "big"
        with big.open("wb") as file:
            file.truncate(1000)
        with pytest.raises(MapError, match="at most 999"):
            map_file.read(big, largest=999)

    def test_a_folder_that_is_not_there_is_named(self, tmp_path: Path) -> None:
        with pytest.raises(MapError, match="can't write"):
            map_file.write(tmp_path / "none" / "x", GOOD)


def test_what_goes_to_the_disk_before_it_takes_its_place_is_all_of_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Else a power cut would leave a name without its bytes."""
    there: list[tuple[bool, int]] = []
    path = tmp_path / "lab.prismmap"
    monkeypatch.setattr(os, "fsync", lambda fd: there.append((path.exists(), os.fstat(fd).st_size)))
    map_file.write(path, GOOD)
    assert there[0] == (False, len(GOOD))
    assert [in_place for in_place, _ in there] == [False, True]


def test_what_a_killed_writer_left_goes_once_it_is_old(tmp_path: Path) -> None:
    path = tmp_path / "lab[1].prismmap"
    old, young = tmp_path / f".{path.name}.a1", tmp_path / f".{path.name}.b2"
    other, stranger = tmp_path / ".lab.prismmap.c3", tmp_path / ".profile"
    for left in (old, young, other, stranger):
        left.write_bytes(b"half")
        os.utime(left, (1.0, 1.0))
    os.utime(young)
    map_file.write(path, GOOD)
    assert path.read_bytes() == GOOD
    assert sorted(p.name for p in tmp_path.glob(".*")) == sorted([young.name, stranger.name])


def test_what_was_left_of_one_file_is_swept_at_any_age(tmp_path: Path) -> None:
    mine, other = tmp_path / ".base.a1", tmp_path / ".based.b2"
    mine.write_bytes(b"half")
    other.write_bytes(b"half")
    map_file.sweep(tmp_path / "base")
    assert not mine.exists()
    assert other.exists(), "another file's"
