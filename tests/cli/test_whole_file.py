"""Files made for the user: what is asked beforehand leaves nothing behind."""

from __future__ import annotations

from pathlib import Path

from prism_edge.cli.whole_file import check_writable, put_whole


def test_to_ask_whether_a_file_can_be_written_leaves_nothing(tmp_path: Path) -> None:
    check_writable(tmp_path / "mask.png", overwrite=False)
    assert list(tmp_path.iterdir()) == []


def test_what_is_written_is_there_alone(tmp_path: Path) -> None:
    put_whole(tmp_path / "mask.png", b"all of it")
    assert [(path.name, path.read_bytes()) for path in tmp_path.iterdir()] == [("mask.png", b"all of it")]
