"""The folder of an evaluation's results: what is written there, and what of an earlier run gives way when."""

from __future__ import annotations

import contextlib
import fcntl
import os
from collections.abc import Container, Iterator, Sequence
from pathlib import Path
from types import TracebackType
from typing import Self

from prism_edge.config import Config
from prism_edge.config_file import dump
from prism_edge.errors import EvaluationError, say
from prism_edge.evaluation.trajectory import Trajectory, write_tum

PATHS = ("live.tum", "final.tum")
MAP = "map.prismmap"
CONFIG, LOG = "effective.yaml", "daemon.log"
FILES = (*PATHS, "truth.tum", MAP, "metrics.json", CONFIG, LOG)


class Results:
    """An earlier run's results stay until the new one has begun: what can't be played costs none of them."""

    def __init__(self, out: Path, kept: Container[Path] = (), further: Sequence[str] = ()) -> None:
        """Files ``kept``, named by their resolved paths, stay; those named ``further`` are results, too."""
        self._out, self._kept = out, kept
        self._names = [name for name in (*FILES, *further) if name not in (CONFIG, LOG)]
        self._config_before: bytes | None = None
        self.begun = False

    def prepare(self, config: Config) -> None:
        """Writes the configuration into the folder. Raises OSError that names it."""
        with results_in(self._out):
            with contextlib.suppress(FileNotFoundError):
                self._config_before = (self._out / CONFIG).read_bytes()
            (self._out / CONFIG).write_text(dump(config))

    def begin(self) -> None:
        """The run has begun: an earlier one's results go. Raises OSError that names the folder."""
        if self.begun:
            return
        self.begun = True
        with results_in(self._out):
            for file in (self._out / name for name in self._names):
                if file.resolve() not in self._kept:
                    file.unlink(missing_ok=True)

    def keep_until_here(self, live: Trajectory) -> None:
        """Writes the poses that came until a run was cut short, and says so. Raises nothing."""
        if not len(live):
            return
        with contextlib.suppress(OSError):
            write_tum(self._out / "live.tum", live)
            where = self._out / "live.tum"
            say(f"prism-edge: warning: the run was not finished: its {len(live)} poses are in {where}")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Where nothing has begun, the configuration beside the earlier results is theirs again."""
        if error is not None and not self.begun and self._config_before is not None:
            with contextlib.suppress(OSError):
                (self._out / CONFIG).write_bytes(self._config_before)


@contextlib.contextmanager
def alone_in(out: Path) -> Iterator[None]:
    """Makes the folder and holds it meanwhile: two runs into one would leave files of both.

    Raises OSError that names it, and EvaluationError where another run has it.
    """
    with results_in(out):
        out.mkdir(parents=True, exist_ok=True)
        held = os.open(out, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        with contextlib.suppress(OSError):  # NFS has no such locks
            try:
                fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise EvaluationError(f"{out}: another run is writing its results there") from None
        yield
    finally:
        os.close(held)


@contextlib.contextmanager
def results_in(out: Path) -> Iterator[None]:
    """An error of writing names the folder, which that of a full disk does not."""
    try:
        yield
    except OSError as error:
        raise OSError(error.errno, f"{error.strerror}: can't write results there", str(out)) from None
