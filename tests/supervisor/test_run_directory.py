"""The run's folder: private, gone at the end, and cleared away after a kill."""

from __future__ import annotations

import os
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from prism_edge.supervisor.run_directory import PREFIX, RunDirectory, default_parent, sweep


def test_is_private_and_vanishes(tmp_path: Path) -> None:
    directory = RunDirectory(tmp_path)
    assert directory.write("config.yaml", "robot: ä\n").read_text(encoding="utf-8") == "robot: ä\n"
    assert stat.S_IMODE(directory.path.stat().st_mode) == 0o700
    directory.remove()
    directory.remove()
    assert list(tmp_path.iterdir()) == []


def test_live_runs_are_left_alone_and_killed_ones_cleared(tmp_path: Path) -> None:
    live = RunDirectory(tmp_path)
    script = (
        "import os, sys; from pathlib import Path;"
        "from prism_edge.supervisor.run_directory import RunDirectory;"
        "print(RunDirectory(Path(sys.argv[1])).path, flush=True); os.kill(os.getpid(), 9)"
    )
    killed = subprocess.run([sys.executable, "-c", script, str(tmp_path)], capture_output=True, text=True)
    abandoned = Path(killed.stdout.strip())
    assert abandoned.is_dir()
    assert live.path.is_dir()
    new = RunDirectory(tmp_path)
    assert set(tmp_path.iterdir()) == {live.path, new.path}
    live.remove()
    new.remove()


def test_sweep_follows_no_links(tmp_path: Path) -> None:
    precious = tmp_path / "precious"
    precious.mkdir()
    (precious / "lock").touch()
    folder = tmp_path / "runtime"
    folder.mkdir()
    (folder / f"{PREFIX}link").symlink_to(precious)
    (folder / f"{PREFIX}file").touch()
    (folder / f"{PREFIX}empty").mkdir()
    sweep(folder)
    assert (precious / "lock").exists()
    assert (folder / f"{PREFIX}file").exists()


def test_lies_in_the_runtime_folder_if_any(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    assert default_parent() == tmp_path
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "missing"))
    assert default_parent().is_dir()
    assert os.access(default_parent(), os.W_OK)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")
def test_a_full_disk_is_named(tmp_path: Path) -> None:
    run = RunDirectory(tmp_path)
    full = run.path / ".new-config.yaml"
    full.symlink_to("/dev/full")
    with pytest.raises(OSError, match="No space left on device") as error:
        run.write("config.yaml", "content")
    assert error.value.filename == str(full)
    run.remove()
