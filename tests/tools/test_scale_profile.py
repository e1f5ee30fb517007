"""tools/scale_profile.py: its figures on made-up series, and the filter on a real network's errors."""

from __future__ import annotations

import subprocess
import sys
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from prism_edge.config import ScaleConfig
from prism_edge.errors import SourceError
from prism_edge.scale.least_squares import Observation
from tests.sources import tiny_datasets as tiny
from tests.synthetic.sequence import write_sequence
from tools import scale_profile


def correlated(count, gap_s, sigma, time_constant_s, seed=0):
    rng = np.random.default_rng(seed)
    phi = np.exp(-gap_s / time_constant_s)
    values = [rng.normal(0, sigma)]
    for _ in range(count - 1):
        values.append(phi * values[-1] + rng.normal(0, sigma * np.sqrt(1 - phi**2)))
    return np.arange(count) * gap_s, np.array(values)


def test_a_recording_that_lists_no_depth_is_one_line(tmp_path):
    folder = write_sequence(tmp_path, frames=3)
    (folder / "depth.txt").write_text("# timestamp filename\n")
    with pytest.raises(SourceError, match="holds no depth images"):
        scale_profile.profile(folder, "none.onnx", "", 1, ScaleConfig())


def test_depth_that_is_not_registered_is_where_the_colour_camera_sees_it(tmp_path, monkeypatch):
    """A slanted wall, and a network that knows it by heart."""
    folder = tiny.write_seven_scenes(tmp_path, count=2)
    across = (np.arange(640) - 320.0) / 585.0
    wall = np.tile(2.0 / (1.0 - 0.8 * across), (480, 1))  # z = 2 + 0.8 x in the depth camera's frame, m
    noise = np.random.default_rng(0).integers(0, 256, (120, 160, 3), dtype=np.uint8).repeat(4, 0).repeat(4, 1)
    for i in range(2):
        assert cv2.imwrite(str(folder / f"frame-{i:06d}.color.png"), noise)
        assert cv2.imwrite(str(folder / f"frame-{i:06d}.depth.png"), np.rint(1000 * wall).astype(np.uint16))

    class Known:
        def infer(self, rgb, camera):
            x = (np.arange(640) - camera.cx) / camera.fx
            depth = np.tile((2.0 + 0.8 * 0.025) / (1.0 - 0.8 * x), (480, 1)).astype(np.float32)
            return SimpleNamespace(depth=depth, image_to_depth=np.array([1.0, 0.0, 1.0, 0.0]))

    monkeypatch.setattr(scale_profile, "open_network", lambda model, config: Known())
    series = scale_profile.profile(folder, "known", "", 1, ScaleConfig())
    assert len(series.values) == 2
    np.testing.assert_allclose(series.values, 0.0, atol=0.002)
    np.testing.assert_allclose(series.whole_image, 0.0, atol=0.002)


def test_autocorrelation_finds_the_time_constant():
    times, values = correlated(20_000, 0.2, 0.15, 2.0)
    for lag in (0.2, 1.0, 3.0):
        found = scale_profile.autocorrelation(times, values, lag)
        assert found == pytest.approx(np.exp(-lag / 2.0), abs=0.05)
    rng = np.random.default_rng(1)
    kept = rng.random(len(times)) > 0.4  # frames without an observation
    for lag in (1.0, 3.0):
        found = scale_profile.autocorrelation(times[kept], values[kept], lag)
        assert found == pytest.approx(np.exp(-lag / 2.0), abs=0.05)
    assert np.isnan(scale_profile.autocorrelation(times[:5], values[:5], 3.0))


def test_filtered_runs_end_at_the_mean_that_the_network_has():
    times, values = correlated(2000, 0.2, 0.15, 2.0, seed=1)
    observations = [Observation(v + 0.3, 0.025, 0.002, 100) for v in values]
    series = scale_profile.Series(times, observations, values)
    config = ScaleConfig(drift_per_sqrt_s=0.0)
    since, error, sigma = scale_profile.filtered(series, 50, config)
    assert since[0] == 0.0
    assert error[0] == pytest.approx(values[50] - values.mean())
    assert abs(error[-1]) < 0.03
    assert sigma[-1] < 0.03
    short = scale_profile.Series(times[:200], observations[:200], values[:200])
    assert "halves" in scale_profile.report(short, config)


def test_a_folder_without_sensor_depth_is_refused_in_one_line(tmp_path):
    (tmp_path / "rgb.txt").write_text("0.0 a.png\n")
    model = tmp_path / "none.onnx"
    for folder, reason in ((tmp_path, "holds no depth images"), (tmp_path / "missing", "missing")):
        command = [sys.executable, scale_profile.__file__, str(folder), "--model", str(model)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
        assert done.returncode != 0
        assert done.stderr.startswith("scale_profile: error: ")
        assert reason in done.stderr
        assert done.stderr.count("\n") == 1


@pytest.mark.realdata
def test_fastdepth_on_a_kitchen_is_averaged_to_within_5_percent(redkitchen, fastdepth):
    config = ScaleConfig()
    series = scale_profile.profile(redkitchen, str(fastdepth), "", 20, config)
    assert len(series.times_s) == 50
    assert abs(series.values.mean()) < 0.05  # focal length accounted for
    assert 0.10 < series.values.std() < 0.18
    _, error, sigma = scale_profile.filtered(series, 0, config)
    assert abs(error[-1]) < 0.05
    assert 0.03 < sigma[-1] < 0.08
    every_start = [scale_profile.filtered(series, first, config) for first in range(0, 45, 5)]
    normalised = np.concatenate([e / s for _, e, s in every_start])
    assert np.mean(normalised**2) < 1.5
