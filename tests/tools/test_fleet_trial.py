"""More than one machine, for real: a router and ten robots; a depth worker behind a link that is cut."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tools.fleet_trial import fleet, main, namespaces

pytestmark = pytest.mark.slow


def test_ten_robots_behind_a_router() -> None:
    missed = {name: found for name, (found, met) in fleet()["checks"].items() if not met}
    assert not missed


def test_depth_on_another_host_that_is_cut_off(tmp_path: Path) -> None:
    with namespaces() as names:
        if names is None:
            pytest.skip("network namespaces are not permitted here")
    code = main(["--out", str(tmp_path), "--cut-s", "30"])
    report = json.loads((tmp_path / "report.json").read_text())["remote depth"]
    assert code == 0, report
