"""Files that a command makes for the user: never over one that is there unasked, and never half of one."""

from __future__ import annotations

import os
from pathlib import Path

from prism_edge.errors import ConfigError
from prism_edge.named_path import hindrance

MAP_BEGINS = b"PRISMMAP"  # of map_file.py, which help does not wait for


def check_writable(path: Path, overwrite: bool) -> None:
    """Before anybody takes the trouble. Raises ConfigError."""
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
    temporary = _beside(path.resolve())
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


def put_whole(path: Path, data: bytes) -> None:
    """All or nothing: a file cut short might be read as another one. Raises OSError with the file's name."""
    file = path.resolve()  # what a link leads to is replaced, not the link
    temporary = _beside(file)
    try:
        temporary.write_bytes(data)
        temporary.replace(file)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise OSError(error.errno, error.strerror, str(path)) from None


def _beside(path: Path) -> Path:
    """In the folder of the file itself, and short: a name may be as long as the system lets it."""
    return path.with_name(f".prism-edge.{os.getpid()}")
