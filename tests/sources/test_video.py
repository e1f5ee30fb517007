"""Video files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from sources import tiny_datasets as tiny

from prism_edge.config import SourceConfig
from prism_edge.errors import SourceError
from prism_edge.sources import Image, Source, open_source


def opened(path: Path) -> Source:
    return open_source(SourceConfig(uri=str(path)))


def test_frames_and_stamps_are_the_containers(tmp_path: Path) -> None:
    with opened(tiny.write_video(tmp_path / "clip.avi", count=10, rate_hz=20.0)) as source:
        assert source.frame_count == 10
        assert source.period_ns == 50_000_000
        items = []
        while (item := source.read()) is not None:
            items.append(item)
        assert source.peek() is None
        assert source.read() is None
    assert [item.index for item in items] == list(range(10))
    assert [item.stamp_ns for item in items] == [50_000_000 * i for i in range(10)]
    for i, item in enumerate(items):
        assert isinstance(item, Image)
        assert item.pixels.shape == (48, 64, 3)
        errors = [np.abs(item.pixels.astype(int) - tiny.picture(j)).mean() for j in range(10)]
        assert int(np.argmin(errors)) == i


def test_skipping_and_what_comes_next(tmp_path: Path) -> None:
    with opened(tiny.write_video(tmp_path / "clip.avi")) as source:
        source.skip()
        source.skip()
        slot, item = source.peek(), source.read()
        assert slot is not None
        assert item is not None
        assert (slot.index, slot.stamp_ns) == (item.index, item.stamp_ns) == (2, 100_000_000)


def test_it_plays_again_once_reopened(tmp_path: Path) -> None:
    source = opened(tiny.write_video(tmp_path / "clip.avi"))
    for _ in range(2):
        with source:
            first = source.read()
            assert first is not None
            assert (first.index, first.stamp_ns) == (0, 0)
        assert source.read() is None


def test_a_truncated_video_ends_early(tmp_path: Path) -> None:
    path = tiny.write_video(tmp_path / "clip.avi", count=20)
    tiny.truncate(path, 0.5)
    with opened(path) as source:
        count = 0
        while source.read() is not None:
            count += 1
    assert 1 <= count < 20


@pytest.mark.parametrize("content", [b"", b"no video", b"RIFF\x10\0\0\0AVI LIST", b"\0" * 500])
def test_what_is_no_video(tmp_path: Path, content: bytes, capfd: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "clip.avi"
    path.write_bytes(content)
    (tmp_path / "camera.yaml").write_text(tiny.CAMERA)
    with pytest.raises(SourceError, match=r"clip\.avi"), opened(path):
        pass
    assert capfd.readouterr().err == "", "FFmpeg's own words are nothing to a user"
