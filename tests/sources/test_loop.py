"""A recording without end."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from sources import tiny_datasets as tiny

from prism_edge.config import SourceConfig
from prism_edge.sources import Image, Source, open_source


def looped(path: Path) -> Source:
    return open_source(SourceConfig(uri=str(path), loop=True))


@pytest.mark.parametrize("kind", ["folder", "video"])
def test_indices_and_stamps_go_on(tmp_path: Path, kind: str) -> None:
    path = tiny.write_tum(tmp_path) if kind == "folder" else tiny.write_video(tmp_path / "clip.avi", 5, 10.0)
    with looped(path) as source:
        assert source.frame_count is None
        assert source.decodes_skipped == (kind == "video")
        items = [source.read() for _ in range(13)]
    assert [item.index for item in items if item] == list(range(13))
    stamps = [item.stamp_ns - items[0].stamp_ns for item in items if item and items[0]]
    assert stamps == [100_000_000 * i for i in range(13)]


def test_skipping_over_the_end_of_a_video_leaves_no_gap(tmp_path: Path) -> None:
    with looped(tiny.write_video(tmp_path / "clip.avi", 3, 10.0)) as source:
        assert all(source.skip() for _ in range(7))
        item = source.read()
        assert item is not None
        assert (item.index, item.stamp_ns) == (7, 700_000_000)


def test_looking_ahead_and_skipping_agree_with_reading(tmp_path: Path) -> None:
    with looped(tiny.write_tum(tmp_path, count=3)) as source:
        seen = []
        for i in range(12):
            slot = source.peek()
            assert slot is not None
            seen.append(slot.index)
            if i % 2:
                source.skip()
            else:
                item = source.read()
                assert item is not None
                assert (item.index, item.stamp_ns) == (slot.index, slot.stamp_ns)
                assert isinstance(item, Image)
                np.testing.assert_array_equal(item.pixels, tiny.picture(i % 3))
    assert seen == list(range(12))


def test_stamps_grow_although_the_recordings_go_back(tmp_path: Path) -> None:
    folder = tiny.write_tum(tmp_path, count=3)
    rows = (folder / "rgb.txt").read_text().splitlines()
    (folder / "rgb.txt").write_text("\n".join([rows[3], rows[4], rows[2]]) + "\n")  # the last goes back
    with looped(folder) as source:
        items = [source.read() for _ in range(4)]
    assert items[3] is not None
    assert items[1] is not None
    assert items[3].index == 3
    assert items[3].stamp_ns > items[1].stamp_ns


def test_a_simulated_worlds_truth_goes_on() -> None:
    config = SourceConfig(uri="sim:room?frames=3&width=64&height=48", loop=True)
    with open_source(config) as source, open_source(replace(config, loop=False)) as once:
        for i in range(7):
            item = source.read()
            assert item is not None
            np.testing.assert_array_equal(source.true_pose(item.index), once.true_pose(i % 3))


@pytest.mark.parametrize("kind", ["folder", "video"])
def test_many_rounds_are_passed_at_once(tmp_path: Path, kind: str) -> None:
    path = tiny.write_tum(tmp_path) if kind == "folder" else tiny.write_video(tmp_path / "clip.avi", 5, 10.0)
    with looped(path) as source:
        first, skipped = source.peek(), 0
        while (slot := source.peek()) is not None and slot.index < 1_000_003:
            skipped += source.leap(1_000_002) == 0 and source.skip()
        item = source.read()
    assert skipped < 12
    assert first is not None
    assert item is not None
    assert (item.index, item.stamp_ns - first.stamp_ns) == (1_000_003, 1_000_003 * 100_000_000)
