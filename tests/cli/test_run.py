"""`prism-edge run` up to the daemon: what it is started with."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from prism_edge.cli.main import main
from prism_edge.config import Config
from prism_edge.supervisor import supervise as module


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Config, dict[str, Any]]]:
    """What daemons were started with; none is."""
    calls: list[tuple[Config, dict[str, Any]]] = []

    def supervise(config: Config, **options: Any) -> int:
        calls.append((config, options))
        return 11

    monkeypatch.setattr(module, "supervise", supervise)
    monkeypatch.setattr("prism_edge.workers.launch.log_as_configured", lambda name, config: None)
    return calls


@pytest.mark.parametrize(("options", "stay"), [([], False), (["--stay"], True)])
def test_it_stays_only_where_told_to_and_gives_the_daemon_s_code(
    options: list[str], stay: bool, started: list[Any]
) -> None:
    assert main(["run", "sim:room?frames=9", *options]) == 11
    [(config, given)] = started
    assert config.source.uri == "sim:room?frames=9"
    assert given["stay"] is stay


def test_a_reload_reads_the_file_again_under_the_same_options(tmp_path: Path, started: list[Any]) -> None:
    file = tmp_path / "robot.yaml"
    file.write_text("robot: one\nscale: {min_points: 20}\n")
    assert main(["run", "sim:room?frames=9", "--config", str(file), "--robot", "mine"]) == 11
    file.write_text("robot: two\nscale: {min_points: 30}\n")
    config = started[0][1]["reread"]()
    assert (config.robot, config.scale.min_points) == ("mine", 30)


def test_what_a_process_would_refuse_starts_no_daemon(started: list[Any]) -> None:
    assert main(["run", "/nowhere/at/all"]) == 4
    assert not started
