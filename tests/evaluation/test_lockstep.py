"""The real daemon on a real recording, twice: lockstep repeats itself to the last digit."""

from __future__ import annotations

from pathlib import Path

import pytest

from prism_edge.config import Config, DepthConfig, SourceConfig
from prism_edge.evaluation.run import evaluate


@pytest.mark.slow
@pytest.mark.realdata
def test_lockstep_twice_with_one_seed_gives_identical_poses(
    shared: Path, fastdepth: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).resolve().parents[2]))
    config = Config(
        mode="lockstep",
        source=SourceConfig(uri=str(shared / "data" / "new_tsukuba")),
        depth=DepthConfig(model=str(fastdepth)),
    )
    reports = [evaluate(config, tmp_path / name) for name in ("first", "second")]
    for report in reports:
        assert report["dropped_frames"] == 0
        assert report["coverage"] >= 0.95
        assert report["final"]["ate_sim3_m"] <= 0.025
    for name in ("live.tum", "final.tum"):
        assert (tmp_path / "first" / name).read_text() == (tmp_path / "second" / name).read_text()
