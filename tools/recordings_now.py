"""What `prism-edge eval` would play and score against now, seen without a word and opened once.

Many runs of a recording are compared with it, one after another (tools/finished_runs.py).
"""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from prism_edge.config import SourceConfig
from prism_edge.errors import PrismError
from prism_edge.evaluation.played import camera_of, images_of, listing_of
from prism_edge.named_path import named_path
from prism_edge.sources import open_source
from prism_edge.sources.listing import Listing
from prism_edge.sources.open import CAMERA_FILES
from prism_edge.sources.truth import read_truth, truth_file

_TABLES = {".txt", ".csv", ".yaml", ".yml"}  # of a recording: stamps, calibration, truth
State = tuple[tuple[str, int, int, int], ...]


@dataclass(frozen=True)
class Recording:
    """What a configuration names, as it is now."""

    source: SourceConfig
    listing: Listing | None  # None: no folder, or of no known kind
    camera: dict[str, Any] | None  # as JSON gives it back, but for whose it is; None: it can't be played

    def truth(self) -> Path | None:
        """Where its own truth lies, as metrics.json has it; None: there is none."""
        found = truth_file(named_path(self.source.uri), self.listing) if self.listing else None
        return Path(os.path.abspath(found)) if found else None

    def images(self) -> str | None:
        """What metrics.json says of its images; None where they lie in no folder."""
        return images_of(self.source, self.listing) if self.listing else None

    def has_true_poses(self) -> bool:
        """Whether its own truth is more than a file without poses."""
        try:
            with _silent_sources():
                return read_truth(self.source.uri) is not None
        except PrismError:
            return True  # damaged: `eval` says where

    def tables(self) -> list[Path]:
        """Its tables: in its folder and on the way to its images; or a video and its camera file."""
        folder = named_path(self.source.uri)
        if not folder.is_dir():
            return [folder, *(folder.with_name(name) for name in CAMERA_FILES)]
        if self.listing is None:
            return []
        images, truth = self.listing.files[0].parent, self.truth()
        between = [path for path in (images, *images.parents) if folder in path.parents]
        found = {path for each in (folder, *between) for path in each.iterdir() if path.suffix in _TABLES}
        return sorted(found.union([truth] if truth else []))


def recording_now(source: SourceConfig) -> Recording:
    """What a configuration names; looked at anew where its files have changed."""
    return _opened(source, _state(source))


@lru_cache(maxsize=64)
def _opened(source: SourceConfig, state: State) -> Recording:
    """Without a word: `eval` has the warnings, and says why what can't be played can't."""
    listing = None
    with _silent_sources():
        try:
            listing = listing_of(source)
            camera = camera_of(open_source(source))
        except (PrismError, OSError):
            return Recording(source, listing, None)
    numbers = {key: value for key, value in camera.items() if key != "origin"}
    return Recording(source, listing, json.loads(json.dumps(numbers)))


def _state(source: SourceConfig) -> State:
    """Of a recording's folders, tables and camera file, or a video; dates can be set, changes not."""
    top = named_path(source.uri)
    watched = [top, *(top.with_name(name) for name in CAMERA_FILES)] if top.name else [top]
    watched += [named_path(source.camera)] if source.camera else []
    for folder, below, names in os.walk(top):
        watched += [Path(folder, name) for name in below]
        watched += [Path(folder, name) for name in names if Path(name).suffix in _TABLES]
    found = []
    for path in watched:
        try:
            stat = path.stat()
        except OSError:
            continue
        found.append((str(path), stat.st_mtime_ns, stat.st_ctime_ns, stat.st_size))
    return tuple(found)


@contextmanager
def _silent_sources() -> Iterator[None]:
    log = logging.getLogger("prism_edge.sources")
    before, log.disabled = log.disabled, True
    try:
        yield
    finally:
        log.disabled = before
