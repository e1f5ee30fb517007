"""Fixtures of pulled networks: a folder, a server and a registry of the test's own."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

from prism_edge.depth import registry
from tests.depth.test_vetting import split
from tests.depth.web_server import WebServer, web_server
from tests.synthetic.network import write_tiny_network


@pytest.fixture
def models(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder that networks are pulled into."""
    monkeypatch.setenv("PRISM_EDGE_MODELS", str(tmp_path / "models"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.delenv("CACHE_DIRECTORY", raising=False)
    return tmp_path / "models"


@pytest.fixture
def server(tmp_path: Path) -> Iterator[WebServer]:
    """Serves a whole network, one with weights beside it, and a checkpoint."""
    with web_server() as running:
        made = tmp_path / "made"
        made.mkdir()
        write_tiny_network(made / "tiny.onnx")
        split(made / "split.onnx", "split.onnx.data")
        running.files = {f"/{path.name}": path.read_bytes() for path in made.iterdir()}
        running.files |= {"/config.json": b"{}", "/model.safetensors": bytes(range(256)) * 100}
        yield running


@pytest.fixture
def register(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator:
    """Puts entries into a registry of the test's own."""

    def put(*models: dict) -> None:
        (tmp_path / "registry.yaml").write_text(yaml.safe_dump({"registry": 1, "models": list(models)}))
        monkeypatch.setattr(registry, "data_folder", lambda: tmp_path)
        registry.entries.cache_clear()

    yield put
    monkeypatch.undo()
    registry.entries.cache_clear()
