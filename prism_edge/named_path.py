"""Files and folders as people name them."""

from __future__ import annotations

import os
from pathlib import Path


def named_path(name: str) -> Path:
    """A leading ~ is a user's home, as in a shell; where there is no such user or home it stays, as there."""
    return Path(os.path.expanduser(name))
