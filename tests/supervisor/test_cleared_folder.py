"""The folder of a run goes while it runs: a cleaner of temporary files, or the user's last logout."""

from __future__ import annotations

import os
import shutil
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from prism_edge.config import Config
from prism_edge.supervisor.reload import put
from prism_edge.supervisor.run_directory import PREFIX
from prism_edge.supervisor.supervisor import Supervisor
from tests.supervisor.fake_daemon import cast
from tests.supervisor.whole_runs import in_time

pytestmark = pytest.mark.usefixtures("left_behind", "slow_is_not_silent")


@pytest.fixture
def run(config: Config) -> Iterator[Supervisor]:
    with Supervisor(config, *cast(["tracker:steady", "depth:steady"])) as run:
        run.run(in_time(lambda: run.ready))
        yield run


@pytest.fixture
def folder(run: Supervisor, tmp_path: Path) -> Path:
    [folder] = tmp_path.glob(PREFIX + "*")
    return folder


def test_it_keeps_nobody_down(
    run: Supervisor, folder: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With what it lay in, which is not made anew: then it is elsewhere for who is started again."""
    elsewhere = tmp_path_factory.mktemp("elsewhere")
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(elsewhere))
    folder.parent.rename(folder.parent.with_name("gone"))
    before = run.processes["depth"]
    os.kill(before, signal.SIGKILL)
    run.run(in_time(lambda: run.processes.get("depth", before) != before and run.ready))
    assert list(elsewhere.glob(f"{PREFIX}*/config.yaml"))
    folder.parent.mkdir()


def test_it_is_there_for_a_reload(run: Supervisor, folder: Path, config: Config) -> None:
    shutil.rmtree(folder)
    run.reload(put(config, "depth.threads", 3))
    assert "threads: 3" in (folder / "config.yaml").read_text()


def test_it_is_made_anew_though_nobody_dies(run: Supervisor, folder: Path) -> None:
    shutil.rmtree(folder)
    run.run(in_time((folder / "config.yaml").exists))  # else the journal in it stays off


def test_it_does_not_move_elsewhere_while_nobody_dies(run: Supervisor, folder: Path) -> None:
    away = folder.parent.with_name("away")
    folder.parent.rename(away)
    run.run(in_time(iter([False] * 3 + [True]).__next__))
    folder.parent.mkdir()
    run.run(in_time((folder / "config.yaml").exists))
