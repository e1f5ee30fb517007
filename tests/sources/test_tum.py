"""Lists of the TUM layout that are damaged, or written otherwise."""

from __future__ import annotations

from pathlib import Path

import pytest
from sources import tiny_datasets as tiny
from sources.opening import all_of, opened, refusal

from prism_edge.errors import SourceError
from prism_edge.sources.truth import read_truth


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ("", ["holds no image"]),
        ("# only a comment\n", ["holds no image"]),
        ("0.1 rgb/a.png extra\n", ["line 1"]),
        ("# c\nsoon rgb/a.png\n", ["line 2", "soon"]),
        ("nan rgb/a.png\n", ["line 1"]),
        ("1e400 rgb/a.png\n", ["line 1"]),
        ("inf rgb/a.png\n", ["line 1"]),
    ],
)
def test_damaged_tum_lists(tmp_path: Path, table: str, words: list[str]) -> None:
    folder = tiny.write_tum(tmp_path)
    (folder / "rgb.txt").write_text(table)
    message = str(refusal(folder))
    for word in words:
        assert word in message


def test_a_list_may_begin_with_the_mark_of_windows_editors(tmp_path: Path) -> None:
    folder = tiny.write_tum(tmp_path)
    rows = (folder / "rgb.txt").read_text()
    for text in (rows, rows.split("filename\n")[1].replace("\n", "\r\n")):  # before a comment, and a stamp
        (folder / "rgb.txt").write_bytes(b"\xef\xbb\xbf" + text.encode())
        assert len(all_of(opened(folder))) == 5


STAMPS = ["1305031102175304000", "1305031102175304", "1305031102175", "1305031102175.3"]


@pytest.mark.parametrize("stamp", STAMPS)
def test_stamps_in_another_unit_are_asked_about(tmp_path: Path, stamp: str) -> None:
    folder = tiny.write_tum(tmp_path)
    for name in ("rgb.txt", "groundtruth.txt"):
        before = (folder / name).read_text()
        (folder / name).write_text(before.replace("1305031102.175304 ", f"{stamp} ", 1))
        with pytest.raises(SourceError) as caught:
            read_truth(str(folder))
        assert f"{name} line " in str(caught.value)
        assert "nanoseconds or milliseconds? lists have seconds" in str(caught.value)
        (folder / name).write_text(before)


def test_a_binary_list_is_refused(tmp_path: Path) -> None:
    folder = tiny.write_tum(tmp_path)
    (folder / "rgb.txt").write_bytes(b"\xff\x00\x80")
    assert "rgb.txt" in str(refusal(folder))
