"""A journal that is cut short anywhere gives back what was whole."""

from __future__ import annotations

import errno
import os
import shutil
import stat
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO, cast

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from prism_edge.backend import journal as module
from prism_edge.backend import map_file
from prism_edge.backend.journal import Journal
from prism_edge.errors import MapError

RECORDS = [bytes([i]) * (10 + i) for i in range(20)]


def base(value: int) -> Callable[[int], bytes]:
    """Makes a base whose array says which it is."""
    return lambda generation: map_file.pack({"generation": generation}, {"v": np.array([value])})


def recovered(folder: Path) -> tuple[int, list[bytes]]:
    found = Journal(folder).recover()
    assert found is not None
    return int(found[1]["v"][0]), found[2]


@pytest.fixture
def written(tmp_path: Path) -> Path:
    journal = Journal(tmp_path / "j")
    journal.begin(base(7))
    for record in RECORDS:
        journal.append(record)
    journal.close()
    return tmp_path / "j"


def test_what_was_written_is_recovered(written: Path) -> None:
    assert recovered(written) == (7, RECORDS)


@pytest.fixture
def _open_umask() -> Iterator[None]:
    """A service's umask may take nothing away."""
    before = os.umask(0)
    yield
    os.umask(before)


@pytest.mark.usefixtures("_open_umask")
def test_only_its_owner_can_read_it(tmp_path: Path) -> None:
    """What it holds is a picture of the inside of somebody's rooms."""
    journal = Journal(tmp_path / "j")
    for generation in range(2):  # the second tail takes the first one's place
        journal.begin(base(generation))
        journal.append(b"more")
        modes = {path.name: stat.S_IMODE(path.stat().st_mode) for path in (tmp_path / "j").iterdir()}
        assert modes == {"base": 0o600, "tail": 0o600}


def test_nothing_to_recover(tmp_path: Path) -> None:
    assert Journal(tmp_path / "new").recover() is None


def test_a_new_base_takes_the_tails_place_and_numbers_go_on(written: Path) -> None:
    journal = Journal(written)
    assert journal.recover() is not None
    journal.begin(base(8))
    assert recovered(written) == (8, [])
    journal.append(b"more")
    assert recovered(written) == (8, [b"more"])


@given(st.integers(0, 10_000), st.integers(0, 255))
@settings(max_examples=80, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_tail_cut_or_damaged_anywhere_gives_what_was_whole(written: Path, at: int, change: int) -> None:
    whole = (written / "tail").read_bytes()
    at %= len(whole)
    damaged = whole[:at] + bytes([whole[at] ^ change]) + whole[at + 1 :] if change else whole[:at]
    (written / "tail").write_bytes(damaged)
    try:
        value, records = recovered(written)
    finally:
        (written / "tail").write_bytes(whole)
    assert value == 7
    assert records == RECORDS[: len(records)]
    # no more is lost than the record that was hit, and those after it
    header = module._HEAD.size
    ends = np.cumsum([header + 8] + [header + len(r) for r in RECORDS])
    assert len(records) == max(int((ends <= at).sum()) - 1, 0)


def test_a_kill_between_base_and_tail_loses_nothing(written: Path) -> None:
    old_tail = (written / "tail").read_bytes()
    journal = Journal(written)
    journal.recover()
    journal.begin(base(8))
    journal.close()
    (written / "tail").write_bytes(old_tail)  # as if the kill had come before the old one was removed
    assert recovered(written) == (8, [])


@pytest.mark.parametrize("damage", [b"", b"noise", None])
def test_a_base_that_is_none_recovers_nothing(written: Path, damage: bytes | None) -> None:
    path = written / "base"
    path.write_bytes(path.read_bytes()[:-1] if damage is None else damage)
    assert Journal(written).recover() is None


def test_a_base_without_generation_recovers_nothing(written: Path) -> None:
    for info in ({}, {"generation": "x"}, {"generation": -1}, {"generation": 2**64}):
        (written / "base").write_bytes(map_file.pack(info, {}))
        assert Journal(written).recover() is None


@pytest.mark.parametrize(("least", "base_size"), [(1000, 10), (10, 1000)])
def test_it_is_long_once_the_tail_has_outgrown_the_base(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, least: int, base_size: int
) -> None:
    """And some bytes: else a large map would be written anew every few seconds, or a small one each time."""
    monkeypatch.setattr(module, "LEAST_TAIL", least)
    journal = Journal(tmp_path)
    journal.begin(lambda _: bytes(base_size))
    written = 0
    while not journal.is_long:
        journal.append(bytes(100))
        written += 100
    assert 900 <= written <= 1100
    journal.begin(base(1))
    assert not journal.is_long


def test_a_folder_that_fails_is_an_error_and_the_next_base_tries_afresh(
    written: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A card that dies, or a share on a network that does: even to look whether a file is there fails."""
    journal = Journal(written)
    journal.begin(base(8))

    def fails(*_: object, **__: object) -> None:
        raise OSError(errno.EIO, "Input/output error")

    with monkeypatch.context() as dying:
        dying.setattr(os, "stat", fails)
        with pytest.raises(MapError):
            journal.append(b"more")
    assert not journal.is_open
    journal.begin(base(9))
    journal.append(b"again")
    assert recovered(written) == (9, [b"again"])


def test_a_full_disk_is_an_error_and_the_next_base_tries_afresh(written: Path) -> None:
    journal = Journal(written)
    journal.begin(base(1))
    real = journal._file
    journal._file = open("/dev/full", "wb", buffering=0)  # noqa: SIM115
    with pytest.raises(MapError, match="No space left"):
        journal.append(b"lost")
    assert real is not None
    real.close()
    assert not journal.is_open
    with pytest.raises(MapError, match="no base"):
        journal.append(b"lost too")
    journal.begin(base(2))
    journal.append(b"kept")
    assert recovered(written) == (2, [b"kept"])


class Crowded:
    """A file on a disk with room for three bytes more: the system writes what fits, and says how much."""

    def __init__(self, real: BinaryIO) -> None:
        self._real, self.close, self.fileno = real, real.close, real.fileno

    def write(self, data: bytes) -> int:
        return self._real.write(data[:3])


def test_nothing_is_added_to_half_a_record(written: Path) -> None:
    journal = Journal(written)
    journal.begin(base(1))
    journal.append(b"kept")
    assert journal._file is not None
    journal._file = cast(BinaryIO, Crowded(journal._file))
    with pytest.raises(MapError, match="all of a record"):
        journal.append(b"half of this")
    assert not journal.is_open, "the next record must begin a new tail"
    assert recovered(written) == (1, [b"kept"])
    journal.begin(base(2))
    journal.append(b"after it")
    assert recovered(written) == (2, [b"after it"])


@pytest.mark.parametrize("taken", [("base", "tail", "."), ("base", "tail"), ("tail",), ("base",)], ids=str)
def test_what_a_cleaner_took_is_an_error_once_and_made_anew(written: Path, taken: tuple[str, ...]) -> None:
    journal = Journal(written)
    journal.begin(base(1))
    for name in taken:
        (written / name).rmdir() if name == "." else (written / name).unlink()
    with pytest.raises(MapError, match="removed"):
        journal.append(b"lost")
    assert not journal.is_open
    journal.begin(base(2))
    journal.append(b"kept")
    assert recovered(written) == (2, [b"kept"])


def test_a_folder_above_that_has_gone_is_not_made(written: Path) -> None:
    """Whoever removed it may have meant to; a run's own is its supervisor's."""
    journal = Journal(written.parent / "run" / "j")
    journal.begin(base(1))
    shutil.rmtree(written.parent / "run")
    with pytest.raises(MapError, match="can't write"):
        journal.begin(base(2))
    assert not (written.parent / "run").exists()


def test_clear_forgets(written: Path) -> None:
    journal = Journal(written)
    journal.clear()
    assert os.listdir(written) == []
    assert journal.recover() is None


def test_nothing_can_be_added_to_what_was_cleared(written: Path) -> None:
    journal = Journal(written)
    journal.begin(base(1))
    journal.clear()
    assert not journal.is_open
    with pytest.raises(MapError, match="no base"):
        journal.append(b"lost")
    assert os.listdir(written) == []


def test_a_base_that_was_being_written_at_a_kill_is_swept(written: Path) -> None:
    (written / ".base.k1ll3d").write_bytes(b"half")
    Journal(written)
    assert sorted(p.name for p in written.iterdir()) == ["base", "tail"]


def test_a_folder_that_can_not_be_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(MapError, match="can't keep a journal"):
        Journal(tmp_path / "file" / "j")
