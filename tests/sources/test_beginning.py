"""The first frames of a recording alone."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from sources import tiny_datasets as tiny

from prism_edge.config import SourceConfig
from prism_edge.errors import ConfigError
from prism_edge.sources import Image, Source, Unreadable, open_source


def first(path: Path | str, frames: int, **more: object) -> Source:
    return open_source(SourceConfig(uri=str(path), frames=frames, **more))  # type: ignore[arg-type]


def recording(folder: Path, kind: str) -> Path:
    return tiny.write_tum(folder) if kind == "folder" else tiny.write_video(folder / "clip.avi", 5, 10.0)


@pytest.mark.parametrize("kind", ["folder", "video"])
@pytest.mark.parametrize(("frames", "played"), [(1, 1), (3, 3), (5, 5), (9, 5)])
def test_it_ends_where_it_is_told_and_is_the_same_until_there(
    tmp_path: Path, kind: str, frames: int, played: int
) -> None:
    path = recording(tmp_path, kind)
    with first(path, frames) as source, first(path, 0) as whole:
        assert source.frame_count == min(frames, 5)
        assert (source.period_ns, source.decodes_skipped) == (whole.period_ns, whole.decodes_skipped)
        for _ in range(played):
            item, same = source.read(), whole.read()
            assert isinstance(item, Image)
            assert isinstance(same, Image)
            assert (item.index, item.stamp_ns) == (same.index, same.stamp_ns)
            np.testing.assert_array_equal(item.pixels, same.pixels)
        assert source.read() is None
        assert source.peek() is None
        assert not source.skip()


@pytest.mark.parametrize("kind", ["folder", "video"])
def test_what_is_skipped_counts(tmp_path: Path, kind: str) -> None:
    with first(recording(tmp_path, kind), 3) as source:
        assert [source.skip() for _ in range(4)] == [True, True, True, False]


def test_what_is_unreadable_counts(tmp_path: Path) -> None:
    folder = tiny.write_tum(tmp_path)
    tiny.truncate(sorted((folder / "rgb").iterdir())[1])
    with first(folder, 2) as source:
        kinds = [type(source.read()) for _ in range(3)]
    assert kinds == [Image, Unreadable, type(None)]


@pytest.mark.parametrize("kind", ["folder", "video"])
def test_looped_it_begins_again_after_them(tmp_path: Path, kind: str) -> None:
    with first(recording(tmp_path, kind), 2, loop=True) as source:
        items = [source.read() for _ in range(5)]
    assert all(isinstance(item, Image) for item in items)
    pixels = [item.pixels for item in items if isinstance(item, Image)]
    assert [item.index for item in items if item] == [0, 1, 2, 3, 4]
    np.testing.assert_array_equal(pixels[4], pixels[0])


def test_a_simulated_walk_is_cut_short_with_its_poses() -> None:
    uri = "sim:room?frames=5&width=64&height=48"
    assert first(uri, 2).peek() is not None, "without opening it"
    with first(uri, 2) as source, first(uri, 0) as whole:
        assert source.synthetic
        assert source.frame_count == 2
        np.testing.assert_array_equal(source.true_pose(1), whole.true_pose(1))
        assert source.read() is not None
        assert source.read() is not None
        assert source.read() is None


def test_a_camera_has_no_first_frames() -> None:
    with pytest.raises(ConfigError, match=r"source\.frames"):
        first("v4l2:/dev/video0", 2, camera="c.yaml")


def test_closed_it_lets_go_of_the_recording(tmp_path: Path) -> None:
    with first(recording(tmp_path, "folder"), 3) as source:
        assert source.peek() is not None
    assert source.peek() is None
