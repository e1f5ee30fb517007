"""The files that a run's figures hang on, and digests by which others in their place are noticed."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable
from contextlib import suppress
from functools import lru_cache
from pathlib import Path

from prism_edge.config import Config
from prism_edge.depth import locate, networks_of
from prism_edge.depth.cards import sidecar_of
from prism_edge.depth.folders import leading_to
from prism_edge.depth.vetting import vet
from prism_edge.errors import ModelError, SourceError
from prism_edge.named_path import named_path
from prism_edge.sources.sim.options import is_simulated, parse


def files_of(config: Config, truth: Path | None) -> list[Path]:
    """What is there of the camera, mask and truth that are given, and each network with its card and weights.

    The truth of 7-Scenes is the folder of its .pose.txt. A simulated world has the way that it follows. Not
    among them are images, videos and tables.
    """
    names = [config.source.camera, config.source.mask]
    if is_simulated(config.source.uri):
        with suppress(SourceError):  # no address
            names.append(parse(config.source.uri).follow)
    files = [named_path(name) for name in names if name]
    files += [truth] if truth is not None else []
    with suppress(ModelError):  # no pair of names
        files += [file for name in networks_of(config.depth.network) for file in _network_files(name)]
    return [file.absolute() for file in files if os.path.exists(file)]


def digests_of(files: Iterable[Path]) -> dict[str, str]:
    """SHA-256 of each by its path, of a folder that of its true poses; "unreadable" where it is."""
    found = {}
    for file in files:
        try:
            found[str(file)] = _of_poses(file) if file.is_dir() else _digest(file, *_dates(file))
        except OSError:
            found[str(file)] = "unreadable"
    return found


def _of_poses(folder: Path) -> str:
    digest = hashlib.sha256()
    for path in sorted(folder.glob("*.pose.txt")):
        digest.update(b"%s %d\n" % (os.fsencode(path.name), path.stat().st_size) + path.read_bytes())
    return digest.hexdigest()


def _network_files(name: str) -> list[Path]:
    try:
        path = locate(name)
    except ModelError:
        return []  # no file's name, or one that is not there
    return [path, *map(sidecar_of, leading_to(path)), *_weights(path, *_dates(path))]


def _dates(file: Path) -> tuple[int, int, int]:
    """What is another where the file is; a date of writing alone can be set."""
    stat = file.stat()
    return stat.st_mtime_ns, stat.st_ctime_ns, stat.st_size


@lru_cache(maxsize=256)
def _digest(file: Path, *dates: int) -> str:
    with file.open("rb") as opened:
        return hashlib.file_digest(opened, "sha256").hexdigest()


@lru_cache(maxsize=8)
def _weights(path: Path, *dates: int) -> tuple[Path, ...]:
    """Files of any name that a network refers to; asked once, as its file is read for it."""
    try:
        return vet(path).data
    except ModelError:
        return ()
