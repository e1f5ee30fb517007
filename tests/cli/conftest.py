"""Fixtures of the commands' tests."""

from __future__ import annotations

from pathlib import Path

import pytest

from prism_edge.cli.main import main
from tests.cli.mapped_room import Call, write_room


@pytest.fixture(scope="session")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a recording of a room, its true map, and networks."""
    return write_room(tmp_path_factory.mktemp("room"))


@pytest.fixture
def call(room: Path, tmp_path: Path) -> Call:
    """The command on the room, writing out.ply into this test's folder."""

    def call(*more: object, source: object = "", map: object = "", model: object = "metric.onnx") -> int:
        words = ["reconstruct", source or room / "seq", "--map", map or room / "room.prismmap"]
        named = room / str(model) if str(model).endswith(".onnx") else model
        return main([str(w) for w in (*words, "--model", named, "--out", tmp_path / "out.ply", *more)])

    return call
