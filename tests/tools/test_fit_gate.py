"""tau and T from views of a wall whose noise is known."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import pytest

from prism_edge.depth.contract import card_from_metadata
from prism_edge.depth.folders import data_folder
from prism_edge.errors import SourceError
from prism_edge.scale.gate import DepthView, weigh
from tests.scale.scene import CAMERA, IMAGE_TO_DEPTH, SHAPE, depth_of_wall
from tools import fit_gate

NONE = np.zeros((0, 0), np.float32)


def recording(sigma: float, views: int = 6, seed: int = 0) -> fit_gate.Keyframes:
    """Views of one wall from one place; each pixel patch's depth errs by ``sigma`` in the log."""
    rng = np.random.default_rng(seed)
    made = []
    for k in range(views):
        noise = np.kron(rng.normal(0, sigma, (SHAPE[0] // 10, SHAPE[1] // 10)), np.ones((10, 10)))
        depth = (depth_of_wall() * np.exp(noise)).astype(np.float32)
        view = DepthView(k, np.eye(4), CAMERA, depth, IMAGE_TO_DEPTH, NONE, 1.0)
        made.append((view, rng.uniform((5, 5), (635, 475), (800, 2))))
    return made


@pytest.mark.parametrize("sigma", [0.02, 0.1])
def test_a_tenth_exceeds_tau_and_the_median_weighs_nine_tenths(sigma):
    recordings = [recording(sigma, seed=seed) for seed in (1, 2)]
    parameters, each = fit_gate.fit(recordings, memory=1)
    u = np.concatenate(each)
    assert np.mean(u > parameters.tau) == pytest.approx(0.1, abs=0.02)
    assert weigh(np.array([np.median(u)]), parameters)[0] == pytest.approx(0.9, abs=0.02)
    # Two independent errors differ by a Gaussian of sqrt(2) sigma; hidden places cut its lower side at tau.
    assert 1.2 * sigma < parameters.tau < 2.5 * sigma


def test_it_grows_with_the_noise():
    quiet, loud = (fit_gate.fit([recording(sigma)], 4)[0] for sigma in (0.02, 0.08))
    assert loud.tau == pytest.approx(4 * quiet.tau, rel=0.25)
    assert loud.temperature == pytest.approx(4 * quiet.temperature, rel=0.4)


def test_a_recording_without_two_views_of_a_place_is_refused():
    with pytest.raises(SourceError, match="nothing to fit"):
        fit_gate.fit([recording(0.05)[:1]], 4)


@pytest.mark.parametrize("more", [[], ["--every", "0"], ["--model", "none"]])
def test_what_can_not_be_fitted_to_ends_in_one_line(more, tmp_path: Path, capsys):
    code = fit_gate.main([str(tmp_path), "--model", "missing.onnx", *more])
    assert code != 0
    error = capsys.readouterr().err
    assert error.startswith("fit_gate: error: ")
    assert error.count("\n") == 1


def test_a_folder_that_is_not_there_is_what_is_said(tmp_path: Path, capsys):
    assert fit_gate.main([str(tmp_path / "nowhere"), "--model", "prism_nano"]) != 0
    assert "does not exist" in capsys.readouterr().err


def test_a_pair_that_is_none_is_said_and_not_fitted_to(tmp_path: Path, capsys):
    """Depth that is called inverse depth: the metric network stands alone, and without any confidence."""
    model = onnx.load(data_folder() / "prism-nano.onnx")
    own = card_from_metadata({prop.key: prop.value for prop in model.metadata_props}, "nano")
    kind = {"depth_kind": "inverse_relative", "canonical_focal_length": None, "scale_bias_sigma": None}
    wrong = tmp_path / "wrong.onnx"
    onnx.helper.set_model_props(model, replace(own, name="wrong", **kind).to_metadata())
    onnx.save(model, wrong)
    world = "sim:room?seed=1&frames=121&width=320&height=240"
    assert fit_gate.main([world, "--model", f"nested:{wrong},prism_nano", "--every", "20"]) == 5
    said = capsys.readouterr()
    assert "were not paired" in said.err
    assert "dsug_tau" not in said.out


@pytest.mark.realdata
def test_the_networks_card_is_what_it_prints(redkitchen: Path, fastdepth: Path, tmp_path: Path, capsys):
    for index in range(0, 120, 12):
        for kind in ("color.jpg", "pose.txt"):
            name = f"frame-{index:06d}.{kind}"
            shutil.copyfile(redkitchen / name, tmp_path / name)
    assert fit_gate.main([str(tmp_path), "--model", str(fastdepth), "--every", "1"]) == 0
    printed = dict(line.split(": ") for line in capsys.readouterr().out.splitlines()[1:])
    assert float(printed["dsug_tau"]) == pytest.approx(0.17, rel=0.5)
    assert float(printed["dsug_temperature"]) == pytest.approx(0.05, rel=0.6)
