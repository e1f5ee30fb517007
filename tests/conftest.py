"""Fixtures shared by all tests."""

from __future__ import annotations

from pathlib import Path

import pytest

CHECKOUT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of recorded sequences and networks beside the checkout; skips where it is absent."""
    folder = CHECKOUT.parent / "shared"
    if not (folder / "data").is_dir():
        pytest.skip("no recorded sequences: there is no folder 'shared' beside the checkout")
    return folder


@pytest.fixture(scope="session")
def redkitchen(shared: Path) -> Path:
    """7-Scenes redkitchen, sequence 1."""
    return shared / "data" / "7scenes_redkitchen" / "seq-01"


@pytest.fixture(scope="session")
def fastdepth(shared: Path) -> Path:
    """The FastDepth network."""
    return shared / "models" / "fastdepth_nyu_224.onnx"
