"""The measuring tool against a recording and a network whose errors are known."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from prism_edge.config import DepthConfig
from prism_edge.depth import open_network
from prism_edge.depth.session import OnnxNetwork
from tests.synthetic.network import TinyNetwork, write_tiny_network
from tests.synthetic.sequence import write_sequence
from tools import measure_depth


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return write_sequence(tmp_path_factory.mktemp("recording"), frames=8)


@pytest.mark.parametrize("gain", [1.0, 1.3])
def test_a_network_that_is_wrong_by_a_factor_is_measured_so(folder: Path, tmp_path: Path, gain: float):
    path = write_tiny_network(tmp_path / "tiny.onnx", TinyNetwork(gain=gain))
    scores, failed = measure_depth.measure(folder, open_network(str(path), DepthConfig()), every=2)
    assert (len(scores), failed) == (4, [])
    assert np.exp(np.mean([score.log_ratio for score in scores])) == pytest.approx(1 / gain, rel=0.01)
    assert np.mean([score.absrel for score in scores]) == pytest.approx(gain - 1, abs=0.015)
    assert np.mean([score.within_125 for score in scores]) == pytest.approx(float(gain < 1.25), abs=0.02)


def test_frames_without_an_answer_are_counted(folder: Path, tmp_path: Path):
    path = write_tiny_network(tmp_path / "bad.onnx", TinyNetwork(misbehaviour="nan"))
    scores, failed = measure_depth.measure(folder, open_network(str(path), DepthConfig()), every=4)
    assert not scores
    assert len(failed) == 2
    assert all("usable" in why for why in failed)


def test_an_inference_that_fails_costs_its_own_frame_alone(folder: Path, tmp_path: Path, monkeypatch, capsys):
    path, infer, calls = write_tiny_network(tmp_path / "tiny.onnx"), OnnxNetwork.infer, []

    def fails_once(*asked):
        calls.append(asked)
        if len(calls) == 2:
            raise RuntimeError("indices out of bounds")
        return infer(*asked)

    monkeypatch.setattr(OnnxNetwork, "infer", fails_once)
    assert measure_depth.main([str(folder), "--model", str(path), "--every", "2"]) == 0
    assert "without a score: 1 (the last: an inference failed: indices out" in capsys.readouterr().out


def test_the_autocorrelation_of_a_known_process():
    rng = np.random.default_rng(0)
    values = np.zeros(20_000)
    for i in range(1, len(values)):
        values[i] = 0.9 * values[i - 1] + rng.normal()
    stamps = np.arange(len(values)) / 30.0
    for lag in (1, 10, 30):
        assert measure_depth.autocorrelation(stamps, values, lag / 30) == pytest.approx(0.9**lag, abs=0.05)
    assert np.isnan(measure_depth.autocorrelation(stamps[:50], values[:50], 10.0))


@pytest.mark.parametrize("arguments", [["nowhere", "--model", "x.onnx"], ["nowhere", "--model", "TINY"]])
def test_what_can_not_be_measured_is_one_line(tmp_path: Path, capsys, arguments: list[str]):
    tiny = str(write_tiny_network(tmp_path / "tiny.onnx"))
    assert measure_depth.main([word.replace("TINY", tiny) for word in arguments]) != 0
    captured = capsys.readouterr()
    assert captured.err.startswith("measure_depth: error: ")
    assert captured.err.count("\n") == 1


def test_a_network_of_a_small_map_has_scores(folder: Path, tmp_path: Path):
    path = write_tiny_network(tmp_path / "tiny.onnx", TinyNetwork(width=80, height=60))  # 20 x 15
    scores, unscored = measure_depth.measure(folder, open_network(str(path), DepthConfig()), every=4)
    assert (len(scores), unscored) == (2, [])


def test_in_little_light_the_network_is_shown_a_darker_and_noisier_picture(folder: Path):
    shown: dict[float, list[np.ndarray]] = {1.0: [], 0.1: []}
    for light, pictures in shown.items():
        network = SimpleNamespace(infer=lambda rgb, camera, into=pictures: into.append(rgb))
        measure_depth.measure(folder, network, 4, light)
    assert len(shown[1.0]) == len(shown[0.1]) == 2
    for full, dim in zip(*shown.values(), strict=True):
        assert dim.mean() == pytest.approx(0.1 * full.mean(), rel=0.05)
        photons = 0.1 * full
        bright = photons > 5
        assert np.var((dim - photons)[bright] / np.sqrt(photons[bright])) == pytest.approx(1.0, rel=0.3)


@pytest.mark.parametrize("light", ["0", "1.5", "-1", "nan", "much"])
def test_a_share_of_the_light_is_one(folder: Path, capsys, light: str):
    with pytest.raises(SystemExit) as ended:
        measure_depth.main([str(folder), "--model", "prism_nano", f"--light={light}"])
    assert ended.value.code == 2
    assert "a share of the light" in capsys.readouterr().err


@pytest.mark.parametrize("every", ["0", "-3", "1.5"])
def test_a_step_between_frames_is_a_whole_number_above_zero(folder: Path, capsys, every: str):
    with pytest.raises(SystemExit) as ended:
        measure_depth.main([str(folder), "--model", "prism_nano", "--every", every])
    assert ended.value.code == 2
    assert "--every" in capsys.readouterr().err
