"""metrics.json: every figure of one run under its name (docs/EVALUATION.md); pure but for version lookup."""

from __future__ import annotations

import dataclasses
import math
import platform
from importlib import metadata
from typing import Any

import numpy as np
from numpy.typing import NDArray

import prism_edge
from prism_edge.config import SENSOR, Config
from prism_edge.evaluation.adjustments import cost_of_adjustments
from prism_edge.evaluation.consistency import NO_NEES, Nees, pose_nees, relative_nees, scale_errors
from prism_edge.evaluation.doubts import (
    apart_in_time,
    guessed_camera,
    no_pose,
    no_truth,
    not_in_the_map,
    not_played,
    placed_later,
    unfinished,
)
from prism_edge.evaluation.loops import judge_loops
from prism_edge.evaluation.played import Played
from prism_edge.evaluation.recording import Recording
from prism_edge.evaluation.resources import VOID_ABOVE, Usage
from prism_edge.evaluation.scores import UNKNOWN, score
from prism_edge.evaluation.trajectory import Trajectory, path_length
from prism_edge.geometry.mount import base_from_camera
from prism_edge.messages import INITIALISING, MapSnapshot

_PACKAGES = ("numpy", "opencv-python-headless", "onnxruntime", "gtsam", "eclipse-zenoh", "rosbags")


def metrics(
    *,
    config: Config,
    recording: Recording,
    snapshot: MapSnapshot | None,
    usage: Usage,
    ready_s: float | None,
    first_stamp_ns: int | None,
    live: Trajectory,
    final: Trajectory,
    final_missing: int,
    truth: Trajectory | None,
    truth_name: str,
    played: Played,
) -> dict[str, Any]:
    """The contents of metrics.json; None wherever something can't be computed."""
    split_ns = None
    if recording.frames:
        split_ns = (recording.frames[0].stamp_ns + recording.frames[-1].stamp_ns) // 2
    scores = {
        name: (score(estimate, truth, split_ns) if truth is not None else UNKNOWN).as_dict()
        for name, estimate in (("live", live), ("final", final))
    }
    mount = base_from_camera(config.frames)
    nees = NO_NEES if truth is None else relative_nees(recording, truth, mount)
    whole = NO_NEES if truth is None else pose_nees(recording, truth, mount)
    flow = recording.flow(first_stamp_ns)
    begun = any(frame.keyframe >= 0 or frame.odometry != INITIALISING for frame in recording.frames)
    silent = no_pose(len(live), flow["frames"], len(recording.frames), begun, played.no_depth)
    until_ns = recording.frames[-1].stamp_ns if config.source.frames and recording.frames else None
    apart = [] if truth is None else apart_in_time(live, truth, scores["live"]["pairs"], until_ns)
    nothing = silent or (apart if not scores["live"]["pairs"] else [])
    refused = not_played(flow["unreadable_frames"], flow["frames"])
    processed = len({frame.index for frame in recording.frames})
    settled = snapshot is not None and snapshot.settled
    later = sum(stamp not in recording.published for stamp in final.stamps.tolist())
    report = {
        **flow,
        "ready_s": ready_s,
        "monocular": config.depth.model != SENSOR,
        **scores,
        **_consistency(nees, whole, scores["final"]["scale_ratio"], recording),
        "final_settled": settled,
        "final_missing": final_missing,
        "final_later": later,
        "truth": truth_name if truth is not None else None,
        "truth_file": played.truth_file if truth is not None else None,
        "path_m": None if truth is None else path_length(_stamps(recording), truth),
        "layout": played.layout,
        "camera": played.camera,
        "camera_found": _found(snapshot, played),
        "images": played.images,
        "files": played.files,
        "cpu_ms_per_frame": _cpu(usage, processed),
        "peak_pss_mb": _with_total(usage.peak_pss_mb, usage.peak_total_pss_mb),
        "foreign_cpu": usage.foreign_cpu,
        "timings_void": usage.foreign_cpu is None or usage.foreign_cpu > VOID_ABOVE,
        "keyframes": len(snapshot.keyframes) - snapshot.carried if snapshot is not None else None,
        "map_points": len(snapshot.points) if snapshot is not None else None,
        "adjustments": cost_of_adjustments(recording),
        "loops": judge_loops(snapshot, recording.frames, truth, scores["final"]["scale_ratio"]),
        "log_scale": snapshot.log_scale if snapshot is not None else None,
        "scale": recording.last_scale(),
        "violations": recording.violations(),
        # Without a network no pose is due, and that was said before.
        "unscored": "; ".join([nothing[0], *refused]) if nothing and config.depth.network else None,
        "warnings": [
            *silent,
            *apart,
            *refused,
            *guessed_camera(played),
            *played.doubts,
            *not_in_the_map(final_missing, len(recording.tracked)),
            *placed_later(later),
            *unfinished(settled or snapshot is None),
            *([] if truth is not None else no_truth(played.layout)),
        ],
        "seed": config.seed,
        "versions": versions(),
        "config": dataclasses.asdict(config),
    }
    return {key: _finite(value) for key, value in report.items()}


def _found(snapshot: MapSnapshot | None, played: Played) -> dict[str, float | None]:
    """What the map was straightened by, besides what is said of the camera; None: nothing was."""
    if snapshot is None or not len(snapshot.camera):
        return {"k1": None, "readout_ms": None}
    said, now = (played.camera or {}).get("distortion"), snapshot.camera[6:].tolist()
    k1 = now[0] if now else 0.0
    return {
        "k1": k1 if k1 != (said[0] if said else 0.0) else None,
        "readout_ms": snapshot.readout_ms or None,
    }


def _consistency(nees: Nees, whole: Nees, scale_ratio: Any, recording: Recording) -> dict[str, Any]:
    scale = recording.last_scale() or {}
    error, to_bias = scale_errors(scale_ratio, scale.get("sigma_log"), recording.bias_sigma)
    return {
        "nees_1s": nees.all,
        "nees_1s_translation": nees.translation,
        "nees_1s_rotation": nees.rotation,
        "nees_1s_pairs": nees.pairs,
        "nees_pose": whole.all,
        "nees_pose_translation": whole.translation,
        "nees_pose_rotation": whole.rotation,
        "scale_log_error_sigmas": error,
        "scale_sigma_to_bias": to_bias,
    }


def _stamps(recording: Recording) -> NDArray[np.int64]:
    return np.unique(np.array([frame.stamp_ns for frame in recording.frames], np.int64))


def versions() -> dict[str, str]:
    """Of this project, Python and the packages whose numbers a result depends on."""
    found = {"prism_edge": prism_edge.__version__, "python": platform.python_version()}
    for package in _PACKAGES:
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            found[package] = "unknown"
    return found


def _cpu(usage: Usage, frames: int) -> dict[str, float | None]:
    if not frames or not usage.cpu_s:
        return {"total": None}
    each = {name: 1000.0 * seconds / frames for name, seconds in usage.cpu_s.items()}
    return _with_total(each, sum(each.values()))


def _finite(value: Any) -> Any:
    """The value with None for every number that JSON has no word for."""
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _with_total(each: dict[str, float], total: float | None) -> dict[str, float | None]:
    return {**dict(sorted(each.items())), "total": total}
