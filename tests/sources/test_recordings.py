"""The readers on real recordings."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from prism_edge.config import SourceConfig
from prism_edge.sources import Image, open_source
from prism_edge.sources.checks import Counts, FrameChecks
from prism_edge.sources.truth import read_truth

pytestmark = pytest.mark.realdata


def played(folder: Path) -> tuple[Counts, list[int], Image]:
    with open_source(SourceConfig(uri=str(folder))) as source:
        checks = FrameChecks(source.camera)
        duplicates, last = [], None
        while (item := source.read()) is not None:
            if checks.check(item).duplicate:
                duplicates.append(item.index)
            last = item
        assert source.frame_count == checks.counts.frames
    assert isinstance(last, Image)
    return checks.counts, duplicates, last


def test_redkitchen_has_a_thousand_images_of_which_ninety_are_copies(redkitchen: Path) -> None:
    counts, duplicates, last = played(redkitchen)
    assert counts == Counts(frames=1000, released=1000, duplicates=90)
    assert min(duplicates) == 228
    assert max(duplicates) == 998
    assert last.stamp_ns == round(999e9 / 30)
    truth = read_truth(str(redkitchen))
    assert truth is not None
    path = np.linalg.norm(np.diff(truth[1][:, :3, 3], axis=0), axis=1).sum()
    assert path == pytest.approx(7.4, abs=0.3)


def test_kitti_is_grey_and_of_odd_width(shared: Path) -> None:
    folder = shared / "data" / "kitti_turn"
    counts, _, last = played(folder)
    assert counts == Counts(frames=51, released=51)
    assert last.pixels.shape == (376, 1241)
    source = open_source(SourceConfig(uri=str(folder)))
    np.testing.assert_allclose(
        source.camera.to_array(), [1241, 376, 718.856, 718.856, 607.1928, 185.2157], rtol=1e-12
    )
    truth = read_truth(str(folder))
    assert truth is not None
    assert len(truth[0]) == 51


@pytest.mark.parametrize(
    ("name", "count", "focal"), [("new_tsukuba", 150, 615.0), ("tartanair_hospital", 189, 320.0)]
)
def test_tum_layouts(shared: Path, name: str, count: int, focal: float) -> None:
    folder = shared / "data" / name
    counts, _, last = played(folder)
    assert counts.frames == counts.released == count
    assert last.pixels.shape == (480, 640, 3)
    assert open_source(SourceConfig(uri=str(folder))).camera.fx == focal
    truth = read_truth(str(folder))
    assert truth is not None
    assert len(truth[0]) == count
