"""Files that a command makes for the user: never over one that is there unasked."""

from __future__ import annotations

from pathlib import Path

from prism_edge.all_or_nothing import beside
from prism_edge.errors import ConfigError
from prism_edge.named_path import hindrance

MAP_BEGINS = b"PRISMMAP"  # of map_file.py, which help does not wait for


def check_writable(path: Path, overwrite: bool) -> None:
    """Before anybody takes the trouble. Raises ConfigError."""
    if str(path) == "-":
        raise ConfigError("-: that is no file's name here: name a file")
    if hindered := hindrance(path):
        raise ConfigError(f"{path} can't be written ({hindered})")
    if path.exists() and not path.is_file() and not path.is_dir():
        raise ConfigError(f"{path} is a pipe or a device; name a file")  # whole, or not at all
    if _is_map(path):
        raise ConfigError(f"{path} is a map, which no command replaces: name another file")
    if path.exists() and not overwrite:
        raise ConfigError(f"{path} is there already: name another, or give --overwrite")
    if not path.parent.is_dir():
        raise ConfigError(f"{path}: there is no folder {path.parent}")
    if path.is_dir():
        raise ConfigError(f"{path} is a folder; name a file")
    temporary = beside(path.resolve())
    try:
        temporary.touch()
        temporary.unlink()
    except OSError as error:
        raise ConfigError(f"{path} can't be written ({error.strerror})") from None


def _is_map(path: Path) -> bool:
    """Whether there is a file that begins as a map does, whatever it is called."""
    try:
        with path.open("rb") as file:
            return file.read(len(MAP_BEGINS)) == MAP_BEGINS
    except OSError:
        return False
