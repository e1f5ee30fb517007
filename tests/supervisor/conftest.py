"""The daemon's configuration with a folder and a port of the test's own, and what must not be left of it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from prism_edge.bus.vacancy import free_endpoint
from prism_edge.config import BusConfig, Config, DepthConfig, SupervisorConfig
from prism_edge.supervisor import liveness
from prism_edge.supervisor.run_directory import PREFIX
from tests.supervisor.whole_runs import DEADLINE_S, assert_port_free

CHECKOUT = Path(__file__).resolve().parents[2]


@pytest.fixture
def config(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Config:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setenv("PYTHONPATH", str(CHECKOUT))
    supervisor = SupervisorConfig(stop_s=1.5, max_restarts=2, backoff_s=0.05)
    bus = BusConfig(free_endpoint())
    return Config(robot="fake", bus=bus, supervisor=supervisor, depth=DepthConfig("net.onnx"))


@pytest.fixture
def slow_is_not_silent(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever gets no processor for seconds is none that hangs, where the supervisor is the test's own."""
    monkeypatch.setattr(liveness, "QUIET_S", DEADLINE_S)
    monkeypatch.setattr(liveness, "SILENT_S", DEADLINE_S)


@pytest.fixture
def left_behind(tmp_path: Path, config: Config) -> Iterator[None]:
    """Checks after the test that the run's folder is gone and its port is free."""
    yield
    assert not list(tmp_path.glob("*" + PREFIX + "*"))
    assert_port_free(config)
