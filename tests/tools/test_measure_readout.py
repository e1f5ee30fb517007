"""Where a recording has nothing left of a readout: by made-up answers, and by a simulated camera."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from prism_edge.config import DepthConfig, SourceConfig
from prism_edge.depth import open_network
from tests.synthetic.network import TinyNetwork, write_tiny_network
from tools import measure_readout


def answers(true: float, slope: float, noise: float, seed: int = 0) -> Callable[[float], tuple[float, float]]:
    rng = np.random.default_rng(seed)
    return lambda said: (slope * (said - true) + noise * rng.normal(), max(noise, 0.1))


@pytest.mark.parametrize("true", [27.0, -18.0, 4.0, 75.0])
def test_the_readout_is_found(true: float) -> None:
    found, sigma = measure_readout.search(answers(true, -0.3, 0.0))
    assert found == pytest.approx(true, abs=1e-6)
    assert 0.0 < sigma < 1.5


@pytest.mark.parametrize("surer", [1.0, 3.0])
def test_its_sigma_is_that_of_its_errors(surer: float) -> None:
    """Also where each time says that it is ``surer`` than it is."""
    found = []
    for seed in range(60):
        answer = answers(25.0, -0.35, 1.0, seed)
        found.append(measure_readout.search(lambda said, answer=answer: (answer(said)[0], 1.0 / surer)))
    in_sigmas = [(readout - 25.0) / sigma for readout, sigma in found]
    assert 0.7 < np.median(np.abs(in_sigmas)) / 0.674 < 1.6


@pytest.mark.parametrize(
    "answer", [answers(20.0, 0.0, 1.0), answers(20.0, 0.4, 0.1), lambda said: (np.nan, np.nan)]
)
def test_a_recording_that_does_not_tell_is_not_made_to(answer) -> None:
    assert measure_readout.search(answer) is None


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_more_is_not_said_than_the_tracker_takes(way: float) -> None:
    said: list[float] = []

    def left_over(readout: float) -> tuple[float, float]:
        said.append(way * readout)
        return 300.0 * way - readout, 1.0

    assert measure_readout.search(left_over)[0] == pytest.approx(300.0 * way)
    assert said == list(np.arange(0.0, measure_readout.LONGEST_READOUT_MS + 1.0, measure_readout.STEP_MS))


def test_a_simulated_camera_s_rows_are_seen() -> None:
    network = open_network("prism_nano", DepthConfig())
    source = SourceConfig(uri="sim:room?seed=1&frames=100&speed=1.2&noise=0.5&blur=0&readout=40")
    unsaid, said = (measure_readout.left_over(source, network, readout)[0] for readout in (0.0, 40.0))
    assert unsaid > 5.0
    assert abs(said) < 2.5


def test_what_it_can_t_use_is_said_in_a_line(tmp_path: Path, capsys) -> None:
    assert measure_readout.main([str(tmp_path / "nothing"), "--model", "prism_nano"]) != 0
    assert measure_readout.main([str(tmp_path)]) != 0
    assert measure_readout.main(["sim:room?frames=20", "--model", str(tmp_path / "no.onnx")]) != 0
    broken = write_tiny_network(tmp_path / "bad.onnx", TinyNetwork(misbehaviour="nan"))
    assert measure_readout.main(["sim:room?frames=20", "--model", str(broken)]) == 1
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 4
    assert all(line.startswith("measure_readout: error: ") for line in said)
