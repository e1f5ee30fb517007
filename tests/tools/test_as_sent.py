"""Tools that speak of what tracker and network see give them what the bus would."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from prism_edge.bus.pack import as_sent, grey, rgb
from prism_edge.config import ScaleConfig
from prism_edge.depth.prediction import Prediction, no_confidence, no_descriptor
from tests.synthetic.sequence import synthetic_camera, write_sequence
from tools import fit_gate, measure_depth, scale_profile

SIZE = (160, 120)


class Watched:
    """A network and an extractor that keep what they are given."""

    bias_sigma = 0.1

    def __init__(self) -> None:
        self.counters: dict[str, int] = {}
        self.colours: list[np.ndarray] = []
        self.greys: list[np.ndarray] = []

    def infer(self, colours: np.ndarray, camera: object) -> Prediction:
        self.colours.append(colours)
        depth = np.linspace(1.0, 2.0, colours[..., 0].size, dtype=np.float32).reshape(colours.shape[:2])
        return Prediction(depth, np.array([1.0, 0.0, 1.0, 0.0]), no_confidence(), no_descriptor(), 1.0)

    def extract(self, luma: np.ndarray, camera: object) -> Any:
        self.greys.append(luma)
        return SimpleNamespace(pixels=np.array([[20.0, 30.0]]))


@pytest.mark.parametrize(
    ("tool", "play"),
    [
        (fit_gate, lambda folder, network: fit_gate.keyframes(folder, network, 1, None)),
        (scale_profile, lambda folder, network: scale_profile.profile(folder, "", "", 1, ScaleConfig())),
        (measure_depth, lambda folder, network: measure_depth.measure(folder, network, 1)),
    ],
)
def test_images_are_seen_as_they_are_sent(
    tool: Any, play: Callable[[Path, Any], object], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, watched = write_sequence(tmp_path, 1, *SIZE), Watched()
    monkeypatch.setattr(tool, "OrbExtractor", lambda config: watched, raising=False)
    monkeypatch.setattr(tool, "open_network", lambda model, config: watched)
    play(folder, watched)
    sent = as_sent(cv2.imread(str(folder / "rgb" / "0.000000.png")), synthetic_camera(*SIZE))
    np.testing.assert_array_equal(watched.colours, [rgb(sent)])
    assert all(np.array_equal(luma, grey(sent)) for luma in watched.greys)
    assert len(watched.greys) == (tool is not measure_depth)
