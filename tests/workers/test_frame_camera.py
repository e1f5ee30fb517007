"""Frames whose camera is masked: what is hidden, and images that the mask does not fit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from prism_edge.config import Config, SourceConfig
from tests.workers.tracker_bench import CONFIG, frame, positions, run, true_position


def masked(folder: Path, width: int, height: int) -> Config:
    """Images ``width`` x ``height`` are masked below their middle."""
    pixels = np.full((height, width), 255, np.uint8)
    pixels[height // 2 :] = 0
    assert cv2.imwrite(str(folder / "mask.png"), pixels)
    return replace(CONFIG, source=SourceConfig(mask=str(folder / "mask.png")))


def test_what_is_masked_is_not_looked_at(bus, world, tmp_path):
    run(bus, [frame(i) for i in range(12)], masked(tmp_path, 320, 240))
    assert max(k.pixels[:, 1].max() for k in bus.of("keyframe")) < 120
    assert positions(bus)[11] == pytest.approx(true_position(11), abs=0.06)


def test_images_of_another_size_than_the_mask_are_passed_over(bus, world, tmp_path, caplog):
    run(bus, [frame(i) for i in range(3)], masked(tmp_path, 640, 480))
    assert bus.pulse.values["malformed"] == "3"
    assert "the mask is for images of another size" in caplog.text
    assert [t.published for t in bus.of("tracked")] == [False] * 3
