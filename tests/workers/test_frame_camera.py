"""Frames and the camera they say: masks, images that a mask does not fit, a readout."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from prism_edge.config import Config, SourceConfig
from prism_edge.workers.frame_camera import FrameCamera
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


def test_a_mask_of_larger_images_hides_the_same_of_smaller_ones(bus, world, tmp_path):
    config = masked(tmp_path, 640, 480)
    smaller = replace(config, source=replace(config.source, shrink=2))
    run(bus, [frame(i) for i in range(12)], smaller)
    assert "malformed" not in bus.pulse.values
    assert max(k.pixels[:, 1].max() for k in bus.of("keyframe")) < 120


def test_images_of_another_size_than_the_mask_are_passed_over(bus, world, tmp_path, caplog):
    run(bus, [frame(i) for i in range(3)], masked(tmp_path, 640, 480))
    assert bus.pulse.values["malformed"] == "3"
    assert "the mask is for images of another size" in caplog.text
    assert [t.published for t in bus.of("tracked")] == [False] * 3


@pytest.mark.parametrize("said", [0.0, 26.0, -9.5])
def test_a_frame_says_how_long_its_rows_are_read(bus, said):
    camera = FrameCamera(bus.pulse, "").of(replace(frame(0), readout_ms=said))
    assert camera is not None
    assert camera.readout_ms == said
    assert camera.bent(0.1).readout_ms == said  # whatever lens is found


def test_a_frame_may_not_say_how_long_its_rows_are_read(bus):
    camera = FrameCamera(bus.pulse, "").of(replace(frame(0), readout_ms=np.nan))
    assert camera is not None
    assert camera.readout_ms is None


@pytest.mark.parametrize("said", [np.inf, 101.0, -np.inf])
def test_a_readout_that_is_none_is_no_camera_s(bus, caplog, said):
    assert FrameCamera(bus.pulse, "").of(replace(frame(0), readout_ms=said)) is None
    assert bus.pulse.values["malformed"] == "1"
    assert "readout_ms" in caplog.text


def test_an_image_smaller_than_its_camera_says_is_no_frame(bus, caplog):
    whole = frame(0)
    for cut in (whole.image[:100], whole.image[:, :-2]):
        assert FrameCamera(bus.pulse, "").of(replace(whole, image=cut)) is None
    assert bus.pulse.values["malformed"] == "2"
    assert "its image is smaller than its camera says" in caplog.text
