"""Where maps are kept from run to run, and under which names."""

from __future__ import annotations

import os
import re
from pathlib import Path

from prism_edge.backend.map_file import SUFFIX
from prism_edge.config import StateConfig
from prism_edge.errors import MapError
from prism_edge.named_path import hindrance, named_path

_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9._-]{0,63}")


def state_directory(config: StateConfig) -> Path:
    """As configured; else systemd's StateDirectory=; else the user's own folder for state (XDG).

    Raises MapError for a user without a home, who has none.
    """
    if config.directory:
        return named_path(config.directory)
    given = os.environ.get("STATE_DIRECTORY", "").partition(":")[0]
    if given:
        return Path(given)
    given = os.environ.get("XDG_STATE_HOME", "")
    folder = Path(given) if os.path.isabs(given) else named_path("~/.local/state")
    if not folder.is_absolute():
        raise MapError("there is no folder for maps: the user has no home; set state.directory")
    return folder / "prism-edge"


def kept_journal(config: StateConfig) -> Path | None:
    """Where the journal is kept from run to run; None where state has no folder, or none is wanted."""
    given = config.directory or os.environ.get("STATE_DIRECTORY")
    return state_directory(config) / "journal" if config.journal and given else None


def map_path(config: StateConfig, name: str) -> Path:
    """The file of a map. Raises MapError for one that could lead elsewhere, or where there is no folder."""
    if not _NAME.fullmatch(name):
        raise MapError(f"{name!r:.80} is no name for a map: up to 64 letters, digits, _ - and . (not first)")
    if name.endswith(SUFFIX):  # `map show` would take it for a file
        raise MapError(f"{name!r:.80} is no name for a map: leave {SUFFIX} out")
    return maps_folder(config) / (name + SUFFIX)


def stored_map(config: StateConfig, name: str) -> Path:
    """The file of a map that there is. Raises MapError, which says what there is, where there is none."""
    path = map_path(config, name)
    if not os.path.exists(path):
        if hindered := hindrance(path):
            raise MapError(f"map {name} can't be read ({hindered})")
        there = ", ".join(map_names(config)) or "none"
        raise MapError(f"there is no map {name} in {maps_folder(config)}; there are: {there}")
    return path


def maps_folder(config: StateConfig) -> Path:
    """The folder of maps."""
    return state_directory(config) / "maps"


def map_names(config: StateConfig) -> list[str]:
    """The maps that there are."""
    try:
        files = os.listdir(maps_folder(config))
    except OSError:
        return []
    return sorted(file.removesuffix(SUFFIX) for file in files if file.endswith(SUFFIX) and file[0] != ".")
