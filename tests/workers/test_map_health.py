"""What `health` shows of a map."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from prism_edge.config import TrackingConfig
from prism_edge.geometry.cameras import Camera
from prism_edge.messages import IDS_A_LIFE, Epoch
from prism_edge.workers.backend import BackendWorker
from prism_edge.workers.map_health import show_map
from tests.workers.backend_bench import CONFIG, hear, keyframes, live
from tests.workers.list_bus import ListBus


def world(camera: Camera | None, readout_ms: float = 0.0) -> Any:
    keyframes, points = dict.fromkeys(range(3)), dict.fromkeys(range(70))
    return SimpleNamespace(keyframes=keyframes, points=points, camera=camera, readout_ms=readout_ms)


def test_its_size_its_lens_and_its_shutter() -> None:
    camera, values = Camera(640, 480, 500.0, 500.0, 320.0, 240.0), {"solve_ms": "12"}
    show_map(values, world(None), 2)
    assert values == {"solve_ms": "12", "keyframes": "3", "points": "70", "behind": "2"}
    show_map(values, world(camera.bent(-0.02), 25.24), 0)
    assert values["k1"] == "-0.0200"
    assert (values["behind"], values["readout_ms"]) == ("0", "25.2")
    show_map(values, world(camera), 0)
    assert "readout_ms" not in values, "another map"
    show_map(values, world(None), 0)
    assert "k1" not in values


def test_of_a_loaded_map_and_of_one_that_has_just_begun(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A map that is only localised in makes no keyframe, with which it would be shown."""
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path / "state"))
    teller, told = keyframes(7)
    live(tmp_path / "a", told[:5], teller, ask=("lab",))
    bus = ListBus("keyframe")
    bus.run_directory = tmp_path / "b"
    made = BackendWorker(replace(CONFIG, tracking=TrackingConfig(levels=8, scale_factor=1.2)), bus)
    assert bus.pulse.values["keyframes"] == "0"
    hear(made, bus, told, teller)
    assert bus.pulse.values["keyframes"] == "7"
    assert made._load_map("lab").ok
    assert bus.pulse.values["keyframes"] == "5"
    bus.give("new_map", Epoch(made._mapper.epoch + 1))
    made._realtime()
    assert (bus.pulse.values["keyframes"], bus.pulse.values["points"]) == ("0", "0")


def test_of_the_map_that_a_backend_started_again_goes_on_in(tmp_path: Path) -> None:
    teller, told = keyframes(5)
    live(tmp_path, told, teller)
    bus = ListBus("keyframe")
    bus.life, bus.first_id, bus.run_directory = 1, IDS_A_LIFE, tmp_path
    BackendWorker(CONFIG, bus)
    assert bus.pulse.values["keyframes"] == "5"
