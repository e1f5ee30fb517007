"""The depth network of the run as it is now: a reload gives another to the processes that run it alone."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import TYPE_CHECKING

from prism_edge.config import Config
from prism_edge.config_file import load
from prism_edge.errors import PrismError

if TYPE_CHECKING:
    from prism_edge.bus.session import Bus

CONFIG = "config.yaml"  # in a run's folder: what its processes start with


class ConfiguredNetwork:
    """``depth.model`` of a run's configuration, read again where that was written anew."""

    def __init__(self, config: Config, bus: Bus) -> None:
        """What this process was started with, until the run's file says otherwise."""
        self._path = None if bus.run_directory is None else bus.run_directory / CONFIG
        self._name, self._read_at = config.depth.network, 0

    @property
    def name(self) -> str:
        """As it is named in the configuration; the last that could be read."""
        written_at = _written_at(self._path)
        if self._path is not None and written_at not in (0, self._read_at):
            with contextlib.suppress(PrismError):
                self._name, self._read_at = load(self._path).depth.network, written_at
        return self._name


def _written_at(path: Path | None) -> int:
    """Nanoseconds since the epoch; 0 where there is none."""
    try:
        return 0 if path is None else path.stat().st_mtime_ns
    except OSError:
        return 0
