"""Where a run's images are, as its source's next life finds it."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from prism_edge.workers.position import NAME, Before, Position, Sent


def test_the_last_is_found_by_the_next_life(tmp_path: Path) -> None:
    first = Position(tmp_path)
    assert first.read() is None
    first.note(Sent(10**12, -5, 3))
    first.note(Sent(7, 2**62, 2**61))
    assert Position(tmp_path).read() == Sent(7, 2**62, 2**61)


def test_a_folder_that_was_cleared_and_made_anew_has_it_again(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    folder.mkdir()
    position = Position(folder)
    position.note(Sent(1, 2, 3))
    shutil.rmtree(folder)
    position.note(Sent(2, 3, 4))  # nowhere yet
    folder.mkdir()
    position.note(Sent(3, 4, 5))
    assert Position(folder).read() == position.read() == Sent(3, 4, 5)


@pytest.mark.parametrize("content", [b"", b"half", bytes(16)])
def test_what_is_none_is_no_position(content: bytes, tmp_path: Path) -> None:
    (tmp_path / NAME).write_bytes(content)
    assert Position(tmp_path).read() is None


def test_where_nothing_can_be_kept_nothing_is(tmp_path: Path) -> None:
    (tmp_path / "other").write_text("mine")
    (tmp_path / NAME).symlink_to(tmp_path / "other")  # never written through
    for folder in (None, tmp_path / "gone", tmp_path):
        position = Position(folder)
        position.note(Sent(1, 2, 3))
        assert position.read() is None
    assert (tmp_path / "other").read_text() == "mine"


@pytest.mark.parametrize(
    ("tracked", "sent"), [((10, 500), (12, 700)), ((12, 700), (10, 500)), (None, (12, 700))]
)
def test_a_source_goes_on_after_whichever_came_last_of_what_was_tracked_and_what_went_out(
    tracked: tuple[int, int] | None, sent: tuple[int, int]
) -> None:
    """Stamps that began again between the two would be of images that have been seen."""
    before = Before.of(tracked, Sent(*sent, since_boot_ns=100))
    assert before is not None
    assert (before.index, before.stamp_ns) == (12, 700)
    assert before.ahead_ns == sent[1] - 100
