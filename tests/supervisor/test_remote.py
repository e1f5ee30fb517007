"""A process on another host, as health shows it."""

from __future__ import annotations

from dataclasses import replace

from prism_edge.config import Config, DepthConfig, NetworkConfig
from prism_edge.supervisor.health import ERROR, OK, WARN
from prism_edge.supervisor.liveness import SILENT_S
from prism_edge.supervisor.remote import RemoteWatch
from prism_edge.supervisor.supervisor import Supervisor
from tests.supervisor.test_liveness import beat


def test_what_is_said_of_it() -> None:
    watch = RemoteWatch("depth")
    assert (watch.row(0.0).level, watch.row(0.0).message) == (ERROR, "not heard from its host")
    watch.heard(beat("idle"), 10.0)
    assert (watch.row(10.5).level, watch.row(10.5).message) == (OK, "idle")
    watch.heard(replace(beat("idle"), values={"warning": "all NaN"}), 11.0)
    assert (watch.row(11.0).level, watch.row(11.0).message) == (WARN, "all NaN")
    cut = watch.row(11.1 + SILENT_S)
    assert cut.level == ERROR
    assert "silent" in cut.message
    watch.heard(beat("idle"), 60.0)  # the link has healed, or it was started again
    assert watch.row(60.0).level == OK


def test_it_is_not_started_here() -> None:
    network = NetworkConfig(endpoint="tcp/0.0.0.0:7448", remote=("depth",))
    supervisor = Supervisor(Config(depth=DepthConfig(model="net.onnx"), network=network))
    assert {"source", "tracker", "scale", "backend"} == set(supervisor._watches)
    assert set(supervisor._remote) == {"depth"}
