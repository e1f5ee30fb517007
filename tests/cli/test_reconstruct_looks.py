"""What becomes of the depth that is said of a keyframe, before there is any cloud."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from prism_edge.cli import reconstruct_looks
from prism_edge.depth.prediction import Prediction
from prism_edge.workers.sensor_network import SensorNetwork
from tests.cli.mapped_room import Call


@pytest.fixture
def as_a_whole(monkeypatch: pytest.MonkeyPatch) -> list[bool]:
    """How depth was to be held to the map's points, which contradict it all."""
    asked: list[bool] = []

    def aligned(depth: Any, image_to_depth: Any, viewpoint: Any, as_a_whole: bool = False) -> None:
        asked.append(as_a_whole)

    monkeypatch.setattr(reconstruct_looks, "aligned", aligned)
    return asked


@pytest.mark.parametrize(("model", "measured"), [("sensor", True), ("metric.onnx", False)])
def test_what_was_measured_is_not_bent_and_what_fits_nothing_is_counted(
    call: Call, as_a_whole: list[bool], capsys: pytest.CaptureFixture[str], model: str, measured: bool
) -> None:
    assert call("--width", 160, model=model) == 10
    assert as_a_whole == [measured] * 8
    error = capsys.readouterr().err
    assert f"left out: 8 keyframes, {reconstruct_looks.NO_FIT}" in error
    assert reconstruct_looks.NO_DEPTH not in error


def test_depth_that_is_called_of_no_use_is_not_used(
    call: Call, as_a_whole: list[bool], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    measure = SensorNetwork.measure

    def doubted(self: SensorNetwork, *where: Any) -> Prediction:
        return replace(measure(self, *where), valid=False)

    monkeypatch.setattr(SensorNetwork, "measure", doubted)
    assert call("--width", 160, model="sensor") == 10
    assert as_a_whole == []
    assert f"left out: 8 keyframes, {reconstruct_looks.NO_DEPTH}" in capsys.readouterr().err
