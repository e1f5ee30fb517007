"""What killed processes leave beside a Unix socket: the sockets that they listened on, and Zenoh's locks."""

from __future__ import annotations

import fcntl
import os
import re
from pathlib import Path


def sweep(path: str) -> None:
    """Remove ``PATH.PID.N`` and its lock, of processes that are gone and where nobody holds the lock.

    Of the living nothing is touched: a lock that is only looked at is one that its owner may fail to get.
    """
    own = re.compile(re.escape(Path(path).name) + r"\.(\d+)\.\d+\.lock")
    try:
        found = [(lock, own.fullmatch(lock.name)) for lock in Path(path).parent.iterdir()]
    except OSError:  # Zenoh says what is wrong with the folder
        return
    for lock, match in found:
        if match is None or _lives(int(match[1])):
            continue
        try:
            held = os.open(lock, os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW)
        except OSError:
            continue
        try:
            fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
            lock.with_suffix("").unlink(missing_ok=True)
            lock.unlink(missing_ok=True)
        except OSError:
            pass  # another container's, or another user's
        finally:
            os.close(held)


def _lives(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        pass
    return True
