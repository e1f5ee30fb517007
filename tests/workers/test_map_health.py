"""What `health` shows of a map."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

from prism_edge.geometry.cameras import Camera
from prism_edge.workers.map_health import show_map


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
