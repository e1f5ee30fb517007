"""Where network files lie: folders that the environment names, the user's cache, the project's own folder."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from prism_edge.named_path import named_path

_MOST_LINKS = 40  # one that leads to the next, as the kernel has it


def data_folder() -> Path:
    """The project's models/: within an installed package, else beside the package in a checkout."""
    package = Path(__file__).resolve().parents[1]
    installed = package / "models"
    return installed if (installed / "registry.yaml").is_file() else package.parent / "models"


def cache_home() -> Path:
    """The project's folder of the user's cache; not made here.

    That is CACHE_DIRECTORY where systemd sets it, else prism-edge in XDG_CACHE_HOME or ~/.cache.
    """
    given = os.environ.get("CACHE_DIRECTORY", "").split(os.pathsep)[0]
    if given:
        return Path(given)
    home = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    return Path(home) / "prism-edge"


def leading_to(path: Path) -> Iterator[Path]:
    """A file as it is named, and of a link each that it leads to in turn."""
    yield path
    seen = {path}
    while path.is_symlink():
        path = path.parent / path.readlink()
        if path in seen or len(seen) > _MOST_LINKS:
            return
        seen.add(path)
        yield path
    if (at := path.resolve()) not in seen:  # a folder on the way is a link
        yield at


def folders() -> list[Path]:
    """Where files of registered networks are looked for, in order: PRISM_EDGE_MODELS, cache, models/."""
    return [*_named(), cache_home() / "models", data_folder()]


def download_folder() -> Path:
    """Where downloads go: the first folder of PRISM_EDGE_MODELS, else the user's cache; not made here."""
    return next(iter(_named()), cache_home() / "models")


def _named() -> list[Path]:
    named = os.environ.get("PRISM_EDGE_MODELS", "").split(os.pathsep)
    return [named_path(part) for part in named if part]
