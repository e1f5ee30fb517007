"""The folder of one run: the effective configuration lies here for the workers."""

from __future__ import annotations

import fcntl
import os
import shutil
import tempfile
from pathlib import Path

PREFIX = "prism-edge-run-"


class RunDirectory:
    """A private folder that vanishes with the run; a lock in it tells a live run from one that was killed."""

    def __init__(self, parent: Path | None = None) -> None:
        """Create the folder below ``parent`` and clear away what killed runs left there."""
        parent = parent or default_parent()
        sweep(parent)
        # Locked before it gets its name, so that nobody's sweep can take it for an abandoned one.
        nameless = tempfile.mkdtemp(prefix=".new-" + PREFIX, dir=parent)
        self._lock = os.open(os.path.join(nameless, "lock"), os.O_CREAT | os.O_RDWR | os.O_CLOEXEC, 0o600)
        fcntl.flock(self._lock, fcntl.LOCK_EX)
        self.path = parent / Path(nameless).name.removeprefix(".new-")
        os.rename(nameless, self.path)

    def write(self, name: str, content: str) -> Path:
        """Write a file of the run, at once or not at all for whoever reads it; returns its path.

        Raises OSError, with the file's name.
        """
        path = self.path / name
        new = self.path / f".new-{name}"
        try:
            new.write_text(content, encoding="utf-8")
        except OSError as error:  # of a full disk, which has no name to tell
            raise OSError(error.errno, error.strerror, str(new)) from None
        os.replace(new, path)
        return path

    def remove(self) -> None:
        """Delete the folder; harmless when it is gone already."""
        shutil.rmtree(self.path, ignore_errors=True)
        if self._lock >= 0:
            os.close(self._lock)
            self._lock = -1


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
            lock = os.open(folder / "lock", os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW)
        except OSError:
            continue
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            shutil.rmtree(folder, ignore_errors=True)
        except OSError:
            pass  # a live run
        finally:
            os.close(lock)
