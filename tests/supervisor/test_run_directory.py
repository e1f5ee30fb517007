"""The run's folder: private, gone at the end, and cleared away after a kill."""

from __future__ import annotations

import fcntl
import os
import shutil
import stat
import subprocess
import sys
import tempfile
from pathlib import Path
from types import SimpleNamespace

import pytest

from prism_edge.supervisor import run_directory
from prism_edge.supervisor.run_directory import LOCK, PREFIX, RunDirectory, default_parent, sweep


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


def test_what_a_cleaner_took_is_made_anew_under_its_name(tmp_path: Path) -> None:
    run = RunDirectory(tmp_path)
    path = run.path
    run.write("config.yaml", "robot: a\n")
    run.write("config.yaml", "robot: b\n")
    run.write("goes-on", "")
    shutil.rmtree(path)
    run.restore()
    assert run.path == path
    assert (path / "config.yaml").read_text() == "robot: b\n"
    assert (path / "goes-on").exists()
    for file in path.iterdir():  # the old files alone, lock and all
        file.unlink()
    run.restore()
    assert {file.name for file in path.iterdir()} == {"config.yaml", "goes-on", LOCK}
    sweep(tmp_path)
    assert path.is_dir(), "it is held again"
    run.remove()
    assert list(tmp_path.iterdir()) == []


def test_a_runtime_folder_that_went_with_its_session(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    runtime, temporary = tmp_path / "runtime", tmp_path / "tmp"
    runtime.mkdir()
    temporary.mkdir()
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(runtime))
    monkeypatch.setattr(tempfile, "tempdir", str(temporary))
    run = RunDirectory()
    run.write("config.yaml", "robot: a\n")
    shutil.rmtree(runtime)
    assert run.write("goes-on", "") == temporary / run.path.name / "goes-on"
    assert (run.path / "config.yaml").read_text() == "robot: a\n"
    run.remove()
    assert list(temporary.iterdir()) == []


@pytest.mark.parametrize("kind", ["folder", "link"])
def test_what_somebody_put_in_its_place_is_not_read(tmp_path: Path, kind: str) -> None:
    """In a temporary folder that all share its name is known."""
    run = RunDirectory(tmp_path)
    run.write("config.yaml", "robot: a\n")
    shutil.rmtree(run.path)
    theirs = tmp_path / "theirs" if kind == "link" else run.path
    theirs.mkdir()
    (theirs / "config.yaml").write_text("robot: theirs\n")
    if kind == "link":
        run.path.symlink_to(theirs)
    with pytest.raises(OSError, match=run.path.name):
        run.restore()
    run.remove()
    assert (theirs / "config.yaml").read_text() == "robot: theirs\n"
    assert not list(tmp_path.glob(".new-*"))


def test_is_locked_for_systemd_s_cleaner(tmp_path: Path) -> None:
    run = RunDirectory(tmp_path)
    folder = os.open(run.path, os.O_RDONLY)
    with pytest.raises(BlockingIOError):
        fcntl.flock(folder, fcntl.LOCK_SH | fcntl.LOCK_NB)
    run.remove()
    fcntl.flock(folder, fcntl.LOCK_SH | fcntl.LOCK_NB)
    os.close(folder)


def test_one_that_can_not_be_held_is_not_left_lying(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(self: RunDirectory, folder: Path) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(RunDirectory, "_hold", full)
    with pytest.raises(OSError, match="No space"):
        RunDirectory(tmp_path)
    assert not list(tmp_path.iterdir())


def test_who_clears_it_is_told_of_once_each_time(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    directory = RunDirectory(tmp_path)
    for _ in range(2):
        shutil.rmtree(directory.path)
        for _ in range(3):
            directory.keep()
        assert directory.path.is_dir()
    assert [record.levelname for record in caplog.records] == ["WARNING"] * 2
    assert str(directory.path) in caplog.messages[0]
    directory.remove()


def test_one_that_can_not_be_made_anew_is_said_once_and_tried_now_and_then(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [100.0]
    monkeypatch.setattr(run_directory, "time", SimpleNamespace(monotonic=lambda: now[0]))
    directory = RunDirectory(tmp_path)
    shutil.rmtree(directory.path)
    directory.path.mkdir()
    (directory.path / "another's").touch()
    directory.keep()
    now[0] += 60.0
    directory.keep()
    assert [record.levelname for record in caplog.records] == ["ERROR"]
    assert "can't be made anew" in caplog.text
    shutil.rmtree(directory.path)
    directory.keep()
    assert not directory.path.exists(), "it is too soon"
    now[0] += 60.0
    directory.keep()
    assert (directory.path / LOCK).exists()
    directory.remove()
