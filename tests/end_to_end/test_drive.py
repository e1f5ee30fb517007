"""A car drives along a street and round a corner: steps of a metre, and depths up to a hundred."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.end_to_end.processes import prism_edge

DRIVE = "sim:street?seed=3&rate=10&width=480&height=240"
STRAIGHT_ON, ROUND_THE_CORNER = 65, 125  # frames: 57 and 84 m


@pytest.mark.parametrize("frames", [STRAIGHT_ON, pytest.param(ROUND_THE_CORNER, marks=pytest.mark.slow)])
def test_metres_are_right_where_depth_is(frames: int, tmp_path: Path) -> None:
    words = ("eval", f"{DRIVE}&frames={frames}", "--model", "sensor", "--lockstep", "--out", tmp_path)
    done = prism_edge(*words, timeout_s=150.0)  # half a minute where nothing else runs
    assert done.returncode == 0, done.stderr
    report = json.loads((tmp_path / "metrics.json").read_text())
    assert not report["monocular"]
    assert report["coverage"] > 0.95
    for name in ("live", "final"):
        assert report[name]["ate_se3_m"] < 0.4
        assert 0.98 < report[name]["scale_ratio"] < 1.02
