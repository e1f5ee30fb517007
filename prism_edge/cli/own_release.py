"""A daemon stays with the release that it was started from, whatever an upgrade makes of a link to it."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence


def go_to_own_release(arguments: Sequence[str]) -> None:
    """Where the environment is named through a link, run the same command in the one that it leads to.

    deploy/install.sh switches such a link (`current`) under a daemon that runs: what that imports late, and
    the workers that it starts again, would be the new release's. ``arguments`` are the interpreter's. Same
    process, so that a service manager's notifications still come from whom it started.
    """
    within = os.path.relpath(sys.executable, sys.prefix)
    own = os.path.join(os.path.realpath(sys.prefix), within)
    if own != sys.executable and not within.startswith(os.pardir) and os.access(own, os.X_OK):
        os.execv(own, [own, *arguments])
