"""Whose the journal in the state directory is: of one run at a time, and told to its processes."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from prism_edge.config import Config, SourceConfig, StateConfig
from prism_edge.config_file import dump
from prism_edge.supervisor.kept_journal import LOCK, KeptJournal
from prism_edge.supervisor.run_directory import RunDirectory
from prism_edge.workers.cut_off import MARK, OWN_JOURNAL, TOLD

CHECKOUT = Path(__file__).resolve().parents[2]
# Another run: it has the journal, and a fork of its own that outlives it, as a worker that hangs would.
OTHER = """
import os, signal, sys
from pathlib import Path
from prism_edge.config_file import load
from prism_edge.supervisor.kept_journal import KeptJournal
from prism_edge.supervisor.run_directory import RunDirectory
journal = KeptJournal(load(sys.argv[1]))
journal.claim(RunDirectory(Path(sys.argv[2])))
worker = os.fork()
if worker:
    print(worker, flush=True)
signal.pause()
"""


@pytest.fixture
def config(tmp_path: Path) -> Config:
    camera = SourceConfig(uri="http://127.0.0.1:9/video")
    return Config(source=camera, state=StateConfig(directory=str(tmp_path / "state")))


@pytest.fixture
def other(config: Config, tmp_path: Path) -> Iterator[Callable[[], None]]:
    """Another run that goes on with the same state; call it to kill its supervisor."""
    (tmp_path / "given.yaml").write_text(dump(config))
    (tmp_path / "runs").mkdir()
    command = [sys.executable, "-c", OTHER, str(tmp_path / "given.yaml"), str(tmp_path / "runs")]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=CHECKOUT)
    assert process.stdout is not None
    worker = int(process.stdout.readline())

    def kill() -> None:
        process.kill()
        process.wait()

    yield kill
    kill()
    os.kill(worker, signal.SIGKILL)
    process.stdout.close()


def claimed(config: Config, folder: Path) -> tuple[KeptJournal, set[str]]:
    """A run's claim, and what its processes are told."""
    folder.mkdir()
    journal, directory = KeptJournal(config), RunDirectory(folder)
    journal.claim(directory)
    told = {path.name for path in directory.path.iterdir()} & {OWN_JOURNAL, TOLD}
    directory.remove()
    return journal, told


@pytest.mark.usefixtures("other")
def test_what_another_run_has_is_neither_used_nor_touched(
    config: Config, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    mark = tmp_path / "state" / "journal" / MARK
    before = mark.read_bytes()
    journal, told = claimed(config, tmp_path / "run")
    assert told == {OWN_JOURNAL}
    assert "another run has it" in caplog.text
    assert len(caplog.records) == 1
    journal.alive()
    journal.gave_up()
    journal.ended()
    journal.release()
    assert mark.read_bytes() == before


# Whether another process, which holds no lock of ours, is refused the file.
REFUSED = """
import fcntl, sys
with open(sys.argv[1], "r+") as file:
    try:
        fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        sys.exit(7)
"""


@pytest.mark.parametrize("whole", [False, True])
def test_a_lock_that_was_cleared_away_is_made_anew(config: Config, tmp_path: Path, whole: bool) -> None:
    journal, _ = claimed(config, tmp_path / "run")
    folder = tmp_path / "state" / "journal"
    shutil.rmtree(tmp_path / "state") if whole else (folder / LOCK).unlink()
    journal.alive()
    assert subprocess.run([sys.executable, "-c", REFUSED, str(folder / LOCK)], check=False).returncode == 7
    journal.ended()
    journal.release()
    assert subprocess.run([sys.executable, "-c", REFUSED, str(folder / LOCK)], check=False).returncode == 0


def test_who_was_cleared_away_and_came_too_late_leaves_the_journal_to_the_other(
    config: Config, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "run").mkdir()
    journal, directory = KeptJournal(config), RunDirectory(tmp_path / "run")
    journal.claim(directory)
    folder = tmp_path / "state" / "journal"
    (folder / LOCK).unlink()
    holds = f"import fcntl, signal; f = open({str(folder / LOCK)!r}, 'w'); fcntl.lockf(f, fcntl.LOCK_EX); "
    command = [sys.executable, "-c", f"{holds}print('locked', flush=True); signal.pause()"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "locked\n"
        try:
            for _ in range(3):
                journal.alive()
            journal.ended()
        finally:
            process.kill()
    assert (folder / MARK).exists()
    assert caplog.text.count("another run has it now") == 1
    assert (directory.path / OWN_JOURNAL).exists(), "a backend that is started again must not go on in it"
    directory.remove()


def test_what_a_killed_run_had_is_the_next_ones_though_a_fork_of_it_lives(
    config: Config, tmp_path: Path, other: Callable[[], None]
) -> None:
    other()
    journal, told = claimed(config, tmp_path / "run")
    assert told == {TOLD}
    journal.ended()
    journal.release()
    journal, told = claimed(config, tmp_path / "next")
    assert told == set()
    journal.release()


@pytest.mark.parametrize(
    "change",
    [
        {"source": SourceConfig(uri="sim:room")},
        {"source": SourceConfig(uri="/a/recording")},
        {"mode": "lockstep"},
    ],
)
def test_a_recording_that_is_played_or_evaluated_leaves_it_alone(
    config: Config, tmp_path: Path, change: dict[str, object], caplog: pytest.LogCaptureFixture
) -> None:
    _, told = claimed(replace(config, **change), tmp_path / "run")  # type: ignore[arg-type]
    assert told == {OWN_JOURNAL}
    assert not (tmp_path / "state").exists()
    assert caplog.records == []


def test_a_map_in_which_a_process_kept_dying_is_not_gone_on_in_again(
    config: Config, tmp_path: Path, other: Callable[[], None]
) -> None:
    other()
    journal, told = claimed(config, tmp_path / "run")
    assert told == {TOLD}
    journal.gave_up()
    journal.release()
    journal, told = claimed(config, tmp_path / "next")
    assert told == set()
    journal.release()


def test_a_run_that_could_not_start_leaves_the_map_to_the_next(
    config: Config, tmp_path: Path, other: Callable[[], None]
) -> None:
    """That of the run before; one of its own it never had."""
    other()
    for name in ("run", "next"):
        journal, told = claimed(config, tmp_path / name)
        assert told == {TOLD}
        journal.refused()
        journal.release()
    journal, _ = claimed(config, tmp_path / "last")
    journal.ended()
    journal.release()
    for name in ("begun", "again"):
        journal, told = claimed(config, tmp_path / name)
        assert told == set()
        journal.refused()
        journal.release()


def test_a_folder_that_can_not_be_costs_the_recovery_alone(
    config: Config, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "state").touch()
    _, told = claimed(config, tmp_path / "run")
    assert told == {OWN_JOURNAL}
    assert "Not a directory" in caplog.text


def test_a_full_disk_as_the_journal_is_lost_does_not_end_the_run(
    config: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "run").mkdir()
    journal, directory = KeptJournal(config), RunDirectory(tmp_path / "run")
    journal.claim(directory)

    def full(*_: object) -> Path:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(directory, "write", full)
    monkeypatch.setattr(journal, "_locked", lambda folder: False)
    monkeypatch.setattr(journal, "_take", lambda folder: "another run has it")
    journal.alive()
    journal.release()
    directory.remove()
