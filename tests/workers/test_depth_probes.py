"""What a lost camera shows the depth worker: the tracker looks for its place by the descriptor alone."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from prism_edge.config import DepthConfig
from prism_edge.depth import open_network
from prism_edge.messages import Acknowledged, probe_of
from prism_edge.workers import depth as worker
from prism_edge.workers.depth import DepthWorker
from tests.synthetic.messages import tick
from tests.synthetic.network import write_tiny_network
from tests.workers.test_depth import live, lockstep, picture


@pytest.fixture
def tiny(tmp_path: Path) -> str:
    return str(write_tiny_network(tmp_path / "tiny.onnx"))


def test_lockstep_answers_what_a_lost_camera_shows_before_its_frame_is_done(tiny: str):
    """It is recognised by that; what came early in between is for its own frame."""
    bus, config = lockstep(tiny)
    shown = [replace(picture(i), keyframe=probe_of(i)) for i in (3, 4)]
    bus.give("keyframe_image", picture(7), *reversed(shown))
    ticks = [replace(tick(i), probe=True) for i in (3, 4)]
    bus.give("tracked", *ticks, tick(5, keyframe=7))
    DepthWorker(config, bus, patience_s=0.05).run()
    order = [message.index if isinstance(message, Acknowledged) else "depth" for _, message in bus.sent]
    assert order == ["depth", 3, "depth", 4, "depth", 5]
    assert [depth.keyframe for depth in bus.of("depth")] == [probe_of(3), probe_of(4), 7]
    assert bus.pulse.values["dropped"] == "0"


def test_what_a_lost_camera_shows_is_warned_of_nowhere(tiny: str, monkeypatch, caplog):
    """No keyframe may follow for hours to take it back: the camera was covered, and stands."""
    network = open_network(tiny, DepthConfig())
    monkeypatch.setattr(worker, "open_depth", lambda config: network)
    monkeypatch.setattr(network, "infer", lambda *picture: 1 / 0)
    bus, config = live(tiny)
    DepthWorker(config, bus)._answer(replace(picture(1), keyframe=probe_of(3)))
    assert [depth.valid for depth in bus.of("depth")] == [False]
    assert "warning" not in bus.pulse.values
    assert bus.pulse.values["invalid"] == bus.pulse.values["keyframes"] == "0"
    assert "has no depth" not in caplog.text
