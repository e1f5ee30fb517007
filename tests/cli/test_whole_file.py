"""Files made for the user: what is asked beforehand leaves nothing behind."""

from __future__ import annotations

from pathlib import Path

import pytest

from prism_edge.all_or_nothing import put_whole
from prism_edge.cli.whole_file import check_writable
from prism_edge.errors import ConfigError


def test_to_ask_whether_a_file_can_be_written_leaves_nothing(tmp_path: Path) -> None:
    check_writable(tmp_path / "mask.png", overwrite=False)
    assert list(tmp_path.iterdir()) == []


def test_a_dash_is_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match="name a file"):
        check_writable(Path("-"), overwrite=True)


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


@pytest.mark.parametrize("stopped", [OSError(28, "No space left on device"), KeyboardInterrupt()])
def test_half_a_file_is_not_left_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stopped: BaseException
) -> None:
    """By a full disk, nor by Ctrl-C; and what was there before still is."""
    (tmp_path / "a.ply").write_bytes(b"before")
    write = Path.write_bytes

    def half(path: Path, data: bytes) -> int:
        write(path, data[:3])
        raise stopped

    monkeypatch.setattr(Path, "write_bytes", half)
    with pytest.raises(type(stopped)):
        put_whole(tmp_path / "a.ply", b"after")
    assert [(path.name, path.read_bytes()) for path in tmp_path.iterdir()] == [("a.ply", b"before")]


def test_who_may_read_a_file_stays_as_it_was(tmp_path: Path) -> None:
    file = tmp_path / "map.ply"
    file.write_bytes(b"before")
    file.chmod(0o640)
    put_whole(file, b"after")
    assert file.read_bytes() == b"after"
    assert file.stat().st_mode & 0o777 == 0o640
