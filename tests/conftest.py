"""Fixtures shared by all tests."""

from __future__ import annotations

# Before NumPy loads: two threads of its BLAS would wait for each other on the cores that two workers share.
import prism_edge.workers  # noqa: F401  # isort: skip - as in the processes, one thread in each library

import os
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import settings

# The same examples in every run: what fails must fail for its author too. `explore` looks for new ones.
settings.register_profile("fixed", derandomize=True, deadline=None)
settings.register_profile("explore", max_examples=1000, deadline=None)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "fixed"))

CHECKOUT = Path(__file__).resolve().parents[1]
WORLDS = "tests/sources/sim/"  # whose files share worlds that take seconds to build
DAEMONS = {"bus", "cli", "deploy", "end_to_end", "live", "supervisor", "workers"}  # folders that start many


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Two workers take a file at a time; daemons would wait for each other, so one worker has theirs."""
    from xdist.scheduler import LoadScopeScheduling

    class ByFile(LoadScopeScheduling):
        def _split_scope(self, nodeid: str) -> str:
            file = nodeid.partition("::")[0]
            if file.startswith(WORLDS):
                return WORLDS
            return file if DAEMONS.isdisjoint(Path(file).parts) else "daemons"

    return ByFile(config, log)


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


@pytest.fixture(scope="session")
def tiny_sequence(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A TUM RGB-D folder of 24 noise images at 30 Hz, with a camera and a true path: 2 m/s along x, bent."""
    folder = tmp_path_factory.mktemp("tiny")
    (folder / "rgb").mkdir()
    rng = np.random.default_rng(0)
    listing, truth = [], []
    for i in range(24):
        cv2.imwrite(str(folder / "rgb" / f"{i}.png"), rng.integers(0, 255, (48, 64, 3), dtype=np.uint8))
        listing.append(f"{100 + i / 30:.6f} rgb/{i}.png\n")
        truth.append(f"{100 + i / 30:.6f} {i / 15:.6f} {(i / 15) ** 2 / 4:.6f} 0 0 0 0 1\n")
    (folder / "rgb.txt").write_text("".join(listing))
    (folder / "groundtruth.txt").write_text("".join(truth))
    (folder / "camera.yaml").write_text("width: 64\nheight: 48\nfx: 60\nfy: 60\ncx: 31.5\ncy: 23.5\n")
    return folder
