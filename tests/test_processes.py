"""Who runs beside whom."""

from __future__ import annotations

import pytest

from prism_edge.config import Config, DepthConfig
from prism_edge.processes import PROCESSES, peers_of


@pytest.mark.parametrize("name", PROCESSES)
def test_peers_are_all_others_that_run(name: str) -> None:
    assert peers_of(Config(depth=DepthConfig("net.onnx")), name) == PROCESSES.keys() - {name}
    assert peers_of(Config(), name) == {"source", "tracker", "scale", "backend"} - {name}
