"""Weights beside a network, looked at again: written to, replaced, removed."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from prism_edge.depth.data_watch import DataWatch
from prism_edge.errors import ModelError


@pytest.fixture
def files(tmp_path: Path) -> tuple[Path, Path]:
    for name in ("first.bin", "second.bin"):
        (tmp_path / name).write_bytes(b"weights")
    return tmp_path / "first.bin", tmp_path / "second.bin"


def test_what_nobody_touched_is_as_it_was(files: tuple[Path, Path]) -> None:
    watch = DataWatch(files)
    for _ in range(2):
        watch.check()
    DataWatch(()).check()


@pytest.mark.parametrize("which", [0, 1])
def test_what_was_written_to_is_named(files: tuple[Path, Path], which: int) -> None:
    watch = DataWatch(files)
    with files[which].open("r+b") as file:
        file.truncate(3)
    with pytest.raises(ModelError, match=f"{files[which].name}: was overwritten"):
        watch.check()


@pytest.mark.parametrize("which", [0, 1])
def test_what_was_removed_or_replaced_is_still_mapped(files: tuple[Path, Path], which: int) -> None:
    watch = DataWatch(files)
    files[which].rename(files[which].with_suffix(".kept"))  # whose inode nobody else gets
    watch.check()
    files[which].write_bytes(b"another's")
    watch.check()
    with files[1 - which].open("ab") as file:
        file.write(b"more")
    with pytest.raises(ModelError, match=f"{files[1 - which].name}: was overwritten"):
        watch.check()


def test_what_can_not_be_read_is_no_weights(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match=f"none.bin: can't be read .{os.strerror(2)}"):
        DataWatch((tmp_path / "none.bin",))
