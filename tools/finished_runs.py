"""Whether a run that is there is what `prism-edge eval` would make now, or is to be repeated.

Compared are what metrics.json holds, the effective configuration, the versions and the camera, and when files
were written that it only names: a recording's tables and truth too. Nothing in it says of which commit the
code was, nor what the images hold.
"""

from __future__ import annotations

import json
import logging
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from prism_edge.cli.eval import effective
from prism_edge.cli.main import build_parser
from prism_edge.config import Config, SourceConfig
from prism_edge.depth import locate, networks_of
from prism_edge.depth.vetting import vet
from prism_edge.errors import ModelError, PrismError
from prism_edge.evaluation.metrics import versions
from prism_edge.evaluation.played import camera_of, listing_of
from prism_edge.named_path import named_path
from prism_edge.sources import open_source
from prism_edge.sources.listing import Listing
from prism_edge.sources.open import CAMERA_FILES
from prism_edge.sources.sim import is_simulated
from prism_edge.sources.truth import read_truth, truth_file

Metrics = dict[str, Any]
OWN_TRUTH = (None, "the sequence's own")
# What an evaluation sets by itself.
_NO_SETTINGS = {"bus.endpoint", "source.wait_s", "source.loop"}
_TABLES = {".txt", ".csv", ".yaml", ".yml"}  # of a recording: stamps, calibration, truth
State = tuple[tuple[str, int, int, int], ...]


@dataclass(frozen=True)
class _Recording:
    """What `eval` would play; None where it can't."""

    listing: Listing | None  # nor of a video or a simulated world
    camera: Metrics | None  # as JSON gives it back, but for whose it is


def finished(where: Path, words: Sequence[str], unscored: bool = False) -> Metrics | None:
    """The metrics in a folder if `prism-edge WORDS` would make them again; else None, and why on stderr.

    A run that had nothing to score is taken where ``unscored`` ones count.
    """
    metrics = metrics_there(where)
    if metrics is None or (metrics.get("unscored") and not unscored):
        return None
    found = differences(where, words, metrics)
    if found:
        print(f"repeated, as {', '.join(found[:5])} differ: {where}", file=sys.stderr)
    return None if found else metrics


def metrics_there(where: Path) -> Metrics | None:
    """The metrics of a run that ended there and isn't void, scored or not; None: there is none."""
    try:
        metrics = json.loads((where / "metrics.json").read_text())
        return metrics if "live" in metrics and not metrics.get("violations") else None
    except (OSError, ValueError, AttributeError, TypeError):
        return None


def differences(where: Path, words: Sequence[str], metrics: Metrics) -> list[str]:
    """What `prism-edge WORDS` would have otherwise than a run in that folder: settings, versions, files."""
    args = build_parser("eval").parse_args(list(words))
    try:
        config = effective(args)
    except PrismError as error:
        return [str(error)]  # `eval` says so too
    defaults, now = (_flat(_as_written(asdict(each))) for each in (Config(), config))
    made = defaults | _flat(metrics.get("config"))  # of what is newer than the run, it had the default
    apart = [key for key in sorted(made.keys() | now.keys()) if made.get(key) != now.get(key)]
    found = [key for key in apart if key not in _NO_SETTINGS]
    then, present = _flat(metrics.get("versions")), versions()
    found += [f"the version of {key}" for key in sorted(present) if then.get(key) != present[key]]
    if not _same_truth(metrics, args.truth, config.source):
        found.append("the truth")
    camera = _recording(config.source).camera
    before = metrics.get("camera")  # runs of earlier builds don't say it
    if camera and isinstance(before, dict) and camera != {key: before.get(key) for key in camera}:
        found.append("the camera")
    named = files_of(config) + tables_of(config.source) + ([args.truth] if args.truth else [])
    made_ns = (where / "metrics.json").stat().st_mtime_ns
    return found + [str(file) for file in named if file.is_file() and file.stat().st_mtime_ns > made_ns]


def _same_truth(metrics: Metrics, given: Path | None, source: SourceConfig) -> bool:
    """Whether a run was scored against what it would be now: the file ``given``, or the recording's own."""
    truth, file = metrics.get("truth"), metrics.get("truth_file")  # runs of earlier builds don't say the file
    if given:
        return bool(truth == str(given))
    if truth not in OWN_TRUTH:
        return False
    if is_simulated(source.uri):
        return truth is not None
    if _recording(source).camera is None:
        return file is None or Path(file).exists()  # `eval` says why it can't be played
    now = _own_truth(source)
    if truth is None:
        return now is None or not _has_poses(source)
    return now is not None and file in (None, os.path.abspath(now))


def _own_truth(source: SourceConfig) -> Path | None:
    listing = _recording(source).listing
    return truth_file(named_path(source.uri), listing) if listing else None


def _has_poses(source: SourceConfig) -> bool:
    """Whether a recording's own truth is more than a file without poses."""
    try:
        with _silent_sources():
            return read_truth(source.uri) is not None
    except PrismError:
        return True  # damaged: `eval` says where


def files_of(config: Config) -> list[Path]:
    """Files that a configuration names: camera, mask, and each network's with its card and weights."""
    files = [named_path(name) for name in (config.source.camera, config.source.mask) if name]
    try:
        networks = networks_of(config.depth.network)
    except ModelError:
        return files
    return files + [file for name in networks for file in _network_files(name)]


def tables_of(source: SourceConfig) -> list[Path]:
    """A recording's tables: in its folder and on the way to its images; or a video and its camera file."""
    folder = named_path(source.uri)
    if not folder.is_dir():
        return [folder, *(folder.with_name(name) for name in CAMERA_FILES)]
    listing, truth = _recording(source).listing, _own_truth(source)
    if listing is None:
        return []
    images = listing.files[0].parent
    between = [path for path in (images, *images.parents) if folder in path.parents]
    tables = {path for each in (folder, *between) for path in each.iterdir() if path.suffix in _TABLES}
    return sorted(tables.union([truth] if truth else []))


def _recording(source: SourceConfig) -> _Recording:
    return _opened(source, _state(source))


@lru_cache(maxsize=64)
def _opened(source: SourceConfig, state: State) -> _Recording:
    """Asked once, and without a word, while a recording's files are in one state; `eval` has the warnings."""
    listing = None
    with _silent_sources():
        try:
            listing = listing_of(source)
            camera = camera_of(open_source(source))
        except (PrismError, OSError):
            return _Recording(listing, None)
    return _Recording(listing, _as_written({key: camera[key] for key in camera if key != "origin"}))


def _state(source: SourceConfig) -> State:
    """Of a recording's folders, tables and camera file, or a video; dates can be set, changes not."""
    top = named_path(source.uri)
    watched = [top, *(top.with_name(name) for name in CAMERA_FILES)]
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


def _network_files(name: str) -> list[Path]:
    try:
        path = locate(name)
    except ModelError:
        return []  # no file's name, or one that is not there
    beside = {file for file in path.parent.iterdir() if file.name.startswith(path.name)}
    return sorted(beside.union(_weights(path, path.stat().st_mtime_ns)))


@lru_cache(maxsize=8)
def _weights(path: Path, written_ns: int) -> tuple[Path, ...]:
    """Files of any name that a network refers to; asked once, as its file is read for it."""
    try:
        return vet(path).data
    except ModelError:
        return ()


def _as_written(values: Any) -> Any:
    """As JSON gives it back."""
    return json.loads(json.dumps(values))


def _flat(values: Any, prefix: str = "") -> dict[str, Any]:
    """Settings by their dotted names; nothing of what is no mapping."""
    flat: dict[str, Any] = {}
    for key, value in values.items() if isinstance(values, dict) else ():
        flat |= _flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value}
    return flat
