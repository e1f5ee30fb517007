"""The folder of one run: the effective configuration lies here for the workers."""

from __future__ import annotations

import contextlib
import fcntl
import logging
import os
import shutil
import tempfile
import time
from pathlib import Path

from prism_edge.errors import in_words

PREFIX = "prism-edge-run-"
LOCK = "lock"
_NEW = ".new-"
_AGAIN_S = 5.0

log = logging.getLogger("prism_edge.supervisor")


class RunDirectory:
    """A private folder that vanishes with the run; locks tell a live run from one that was killed."""

    def __init__(self, parent: Path | None = None) -> None:
        """Create the folder below ``parent`` and clear away what killed runs left there."""
        parent = parent or default_parent()
        sweep(parent)
        self._held: list[int] = []  # descriptors: of the folder, and of the lock in it
        self._written: dict[str, str] = {}
        self._again_s = 0.0  # when it is to be kept once more; 0: it was, the last time
        new = self._nameless(parent)
        self.path = parent / new.name.removeprefix(_NEW)
        os.rename(new, self.path)

    def write(self, name: str, content: str) -> Path:
        """Write a file of the run, at once or not at all for whoever reads it; returns its path.

        Raises OSError, with the file's name.
        """
        self.restore()
        self._write(name, content)
        self._written[name] = content
        return self.path / name

    def restore(self) -> None:
        """Make anew what somebody cleared away: a cleaner of temporary files, or the user's last logout.

        Under the same name, by which a restarted backend knows its journal; ``path`` may be elsewhere then.
        Raises OSError, also where that name is another's by now: what lies there is not ours to read.
        """
        if not self._stands():
            parent = self.path.parent if self.path.parent.is_dir() else default_parent()
            self._release()
            new = self._nameless(parent)
            try:
                os.rename(new, parent / self.path.name)
            except OSError:
                shutil.rmtree(new, ignore_errors=True)
                raise
            self.path = parent / self.path.name
        elif not (self.path / LOCK).exists():
            self._release()
            self._hold(self.path)
        for name, content in self._written.items():
            if not (self.path / name).exists():
                self._write(name, content)

    def keep(self) -> None:
        """Restore it in its place, called all the time: many a run's journal lies there. Raises nothing."""
        # What it lies in is brought back by the next login.
        if time.monotonic() < self._again_s or not self.path.parent.is_dir():
            return
        stood, failed, self._again_s = self._stands(), self._again_s > 0.0, 0.0
        try:
            self.restore()
        except OSError as error:
            self._again_s = time.monotonic() + _AGAIN_S
            if not failed:
                why = in_words(error)
                log.error("somebody has cleared %s away, and it can't be made anew: %s", self.path, why)
            return
        if not stood:
            log.warning("somebody has cleared %s away: it is made anew", self.path)

    def remove(self) -> None:
        """Delete the folder; harmless when it is gone already."""
        if self._stands():
            shutil.rmtree(self.path, ignore_errors=True)
        self._release()

    def _nameless(self, parent: Path) -> Path:
        """A folder that is held before it gets its name, so that nobody's sweep takes it for abandoned."""
        new = Path(tempfile.mkdtemp(prefix=_NEW + PREFIX, dir=parent))
        try:
            self._hold(new)
        except OSError:
            self._release()
            shutil.rmtree(new, ignore_errors=True)
            raise
        return new

    def _hold(self, folder: Path) -> None:
        self._held = [os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)]
        with contextlib.suppress(OSError):  # which systemd-tmpfiles respects; NFS has no such locks
            fcntl.flock(self._held[0], fcntl.LOCK_EX | fcntl.LOCK_NB)
        self._held.append(os.open(folder / LOCK, os.O_CREAT | os.O_RDWR | os.O_CLOEXEC, 0o600))
        fcntl.flock(self._held[1], fcntl.LOCK_EX)

    def _release(self) -> None:
        while self._held:
            os.close(self._held.pop())

    def _stands(self) -> bool:
        """Whether what bears our name is the very folder that we made."""
        try:
            return os.path.samestat(os.fstat(self._held[0]), os.lstat(self.path))
        except (OSError, IndexError):
            return False

    def _write(self, name: str, content: str) -> None:
        path, new = self.path / name, self.path / (_NEW + name)
        try:
            new.write_text(content, encoding="utf-8")
        except OSError as error:  # of a full disk, which has no name to tell
            raise OSError(error.errno, error.strerror, str(new)) from None
        os.replace(new, path)


def default_parent() -> Path:
    """The user's runtime folder where there is one, else the folder for temporary files."""
    runtime = os.environ.get("XDG_RUNTIME_DIR", "")
    if runtime and os.path.isdir(runtime) and os.access(runtime, os.W_OK | os.X_OK):
        return Path(runtime)
    return Path(tempfile.gettempdir())


def sweep(parent: Path) -> None:
    """Remove the folders of our own killed runs: those whose lock nobody holds."""
    for folder in parent.glob(PREFIX + "*"):
        try:
            # Others write to a shared temporary folder too: never follow their links.
            if folder.is_symlink() or folder.stat().st_uid != os.getuid():
                continue
            lock = os.open(folder / LOCK, os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW)
        except OSError:
            continue
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            shutil.rmtree(folder, ignore_errors=True)
        except OSError:
            pass  # a live run
        finally:
            os.close(lock)
