"""Whether a run that is there is what `prism-edge eval` would make now, or is to be repeated.

Compared are what metrics.json holds, the effective configuration, the versions, the camera, digests of the
networks, the mask and the truth, and the images' names and sizes; and when a recording's tables were written.
Nothing in it says of which commit the code was, nor what the images hold.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from prism_edge.cli.eval import effective
from prism_edge.cli.main import build_parser
from prism_edge.config import Config
from prism_edge.errors import PrismError
from prism_edge.evaluation.files import digests_of, files_of
from prism_edge.evaluation.metrics import versions
from prism_edge.evaluation.resources import VOID_ABOVE
from prism_edge.sources.sim import is_simulated
from tools.recordings_now import Recording, recording_now

Metrics = dict[str, Any]
OWN_TRUTH = (None, "the sequence's own")
# What an evaluation sets by itself.
_NO_SETTINGS = {"bus.endpoint", "source.wait_s", "source.loop", "log.form", "log.level"}


def finished(where: Path, words: Sequence[str], unscored: bool = False) -> Metrics | None:
    """The metrics in a folder if `prism-edge WORDS` would make them again; else None, and why on stderr.

    A run that had nothing to score is taken where ``unscored`` ones count, none whose timings are void.
    """
    metrics = metrics_there(where)
    if metrics is None or (metrics.get("unscored") and not unscored):
        return None
    if others_used_the_machine(metrics):
        print(f"repeated, as others used the machine meanwhile: {where}", file=sys.stderr)
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


def others_used_the_machine(metrics: Metrics) -> bool:
    """Whether a run in real time had less of the machine than it should have had."""
    mode = (metrics.get("config") or {}).get("mode")
    return mode != "lockstep" and (metrics.get("foreign_cpu") or 0.0) > VOID_ABOVE


def frames_with_a_pose(metrics: Metrics) -> int:
    """Frames that had a pose as they came, or have one since a loop placed them."""
    return int(metrics["tracked"]) + int(metrics.get("final_later") or 0)  # earlier builds' runs don't say


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
    recording = recording_now(config.source)
    same_truth = _same_truth(metrics, args.truth, recording)
    found += [] if same_truth else ["the truth"]
    camera = recording.camera
    before = metrics.get("camera")  # runs of earlier builds don't say it
    if camera and isinstance(before, dict) and camera != {key: before.get(key) for key in camera}:
        found.append("the camera")
    images, before = recording.images(), metrics.get("images")  # likewise
    if images and before and images != before:
        found.append("the images")
    truth = args.truth or recording.truth()
    named, dated = files_of(config, truth if same_truth else None), recording.tables()
    digests = metrics.get("files")  # likewise
    if isinstance(digests, dict):
        there = digests_of(named)
        gone = digests.keys() if same_truth else ()  # else the truth's may be among them, which is said
        found += [file for file in sorted({*there, *gone}) if digests.get(file) != there.get(file)]
    else:
        dated = [*named, *dated]
    made_ns = (where / "metrics.json").stat().st_mtime_ns
    newer = (str(file) for file in dated if file.is_file() and file.stat().st_mtime_ns > made_ns)
    return found + [file for file in newer if file not in (digests or ())]


def _same_truth(metrics: Metrics, given: Path | None, recording: Recording) -> bool:
    """Whether a run was scored against what it would be now: the file ``given``, or the recording's own."""
    truth, file = metrics.get("truth"), metrics.get("truth_file")  # runs of earlier builds don't say the file
    if given:
        return bool(truth == str(given))
    if truth not in OWN_TRUTH:
        return False
    if is_simulated(recording.source.uri):
        return truth is not None
    if recording.camera is None:
        return file is None or Path(file).exists()  # `eval` says why it can't be played
    now = recording.truth()
    if truth is None:
        return now is None or not recording.has_true_poses()
    return now is not None and file in (None, str(now))


def _as_written(values: Any) -> Any:
    """As JSON gives it back."""
    return json.loads(json.dumps(values))


def _flat(values: Any, prefix: str = "") -> dict[str, Any]:
    """Settings by their dotted names; nothing of what is no mapping."""
    flat: dict[str, Any] = {}
    for key, value in values.items() if isinstance(values, dict) else ():
        flat |= _flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value}
    return flat
