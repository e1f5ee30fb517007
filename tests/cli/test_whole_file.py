"""Files made for the user: what is asked beforehand leaves nothing behind."""

from __future__ import annotations

from pathlib import Path

import pytest

from prism_edge.cli.whole_file import check_writable, put_whole
from prism_edge.errors import ConfigError


def test_to_ask_whether_a_file_can_be_written_leaves_nothing(tmp_path: Path) -> None:
    check_writable(tmp_path / "mask.png", overwrite=False)
    assert list(tmp_path.iterdir()) == []


def test_what_is_written_is_there_alone(tmp_path: Path) -> None:
    put_whole(tmp_path / "mask.png", b"all of it")
    assert [(path.name, path.read_bytes()) for path in tmp_path.iterdir()] == [("mask.png", b"all of it")]


def test_what_a_link_leads_to_is_replaced_and_not_the_link(tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    file, link = tmp_path / "elsewhere" / "a.ply", tmp_path / "link.ply"
    file.write_bytes(b"before")
    link.symlink_to(file)
    check_writable(link, overwrite=True)
    put_whole(link, b"after")
    assert link.is_symlink()
    assert file.read_bytes() == b"after"
    assert [path.name for path in tmp_path.glob("*/*")] == ["a.ply"]


def test_a_name_may_be_as_long_as_the_system_lets_it(tmp_path: Path) -> None:
    check_writable(tmp_path / ("x" * 255), overwrite=False)
    put_whole(tmp_path / ("x" * 255), b"all of it")
    with pytest.raises(ConfigError, match=r"can't be written \(File name too long\)"):
        check_writable(tmp_path / ("x" * 256), overwrite=False)
