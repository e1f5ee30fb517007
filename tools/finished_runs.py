"""Whether a run that is there is what `prism-edge eval` would make now, or is to be repeated.

Compared are what metrics.json holds, the effective configuration, the versions and the camera, and when files
were written that it only names: a recording's tables and truth too. Nothing in it says of which commit the
code was, nor what the images hold.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import asdict
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
from prism_edge.evaluation.played import played
from prism_edge.named_path import named_path
from prism_edge.sources import open_source
from prism_edge.sources.open import CAMERA_FILES, find_listing
from prism_edge.sources.truth import truth_file

Metrics = dict[str, Any]
OWN_TRUTH = (None, "the sequence's own")
# What an evaluation sets by itself.
_NO_SETTINGS = {"bus.endpoint", "source.wait_s", "source.loop"}
_TABLES = {".txt", ".csv", ".yaml", ".yml"}  # of a recording: stamps, calibration, truth


def finished(where: Path, words: Sequence[str]) -> Metrics | None:
    """The metrics in a folder if `prism-edge WORDS` would make them again; else None, and why on stderr."""
    metrics = metrics_there(where)
    if metrics is None:
        return None
    found = differences(where, words, metrics)
    if found:
        print(f"repeated, as {', '.join(found[:5])} differ: {where}", file=sys.stderr)
    return None if found else metrics


def metrics_there(where: Path) -> Metrics | None:
    """The metrics of a run that ended there as it should; None: there is none."""
    try:
        metrics = json.loads((where / "metrics.json").read_text())
        void = metrics.get("violations") or metrics.get("unscored")
        return metrics if "live" in metrics and not void else None
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
    if not _same_truth(metrics, args.truth):
        found.append("the truth")
    camera = _camera(config.source)
    before = metrics.get("camera")  # runs of earlier builds don't say it
    if camera and isinstance(before, dict) and camera != {key: before.get(key) for key in camera}:
        found.append("the camera")
    named = files_of(config) + tables_of(config.source) + ([args.truth] if args.truth else [])
    made_ns = (where / "metrics.json").stat().st_mtime_ns
    return found + [str(file) for file in named if file.is_file() and file.stat().st_mtime_ns > made_ns]


def _same_truth(metrics: Metrics, given: Path | None) -> bool:
    """Whether a run was scored against the truth ``given``, or the recording's own, which is still there."""
    truth, file = metrics.get("truth"), metrics.get("truth_file")
    if given:
        return bool(truth == str(given))
    return truth in OWN_TRUTH and (file is None or Path(file).exists())


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
    try:
        listing = find_listing(folder)
    except PrismError:
        return []
    images, truth = listing.files[0].parent, truth_file(folder, listing)
    between = [path for path in (images, *images.parents) if folder in path.parents]
    tables = {path for each in (folder, *between) for path in each.iterdir() if path.suffix in _TABLES}
    return sorted(tables.union([truth] if truth else []))


def _camera(source: SourceConfig) -> dict[str, Any] | None:
    """The intrinsics that a run would have now, as JSON gives them back; None where there are none to see."""
    try:
        camera = played(source, open_source(source), None).camera or {}
    except (PrismError, OSError):
        return None  # `eval` says why
    return dict(_as_written({key: value for key, value in camera.items() if key != "origin"}))


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
