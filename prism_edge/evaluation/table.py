"""The figures that matter, for a reader at a terminal."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from prism_edge.evaluation.scores import of_own_length

OWN_LENGTH = "over shares of a path that holds no 100 m: not to be compared with KITTI's figures"
_BOTH = ("live", "final")
_OF_SEGMENTS = ("t_rel_percent", "r_rel_deg_per_100m")


def show(metrics: dict[str, Any], out: Path) -> None:
    """Prints a short table of metrics.json's contents on stdout."""
    console = Console(markup=False, emoji=False)  # paths may hold [brackets] and :colons:
    errors = Table("", "live", "final", title="errors" if metrics["truth"] else "errors (no truth)")
    for label, key, factor, unit in (
        ("ATE SE(3)", "ate_se3_m", 100.0, "cm"),
        ("ATE Sim(3)", "ate_sim3_m", 100.0, "cm"),
        ("scale ratio", "scale_ratio", 1.0, ""),
        ("RPE over 1 s", "rpe_trans_m", 100.0, "cm"),
        ("RPE over 1 s", "rpe_rot_deg", 1.0, "deg"),
        ("t_rel", "t_rel_percent", 1.0, "%"),
        ("r_rel", "r_rel_deg_per_100m", 1.0, "deg/100 m"),
    ):
        starred = [key in _OF_SEGMENTS and of_own_length(metrics[w]["t_rel_lengths_m"]) for w in _BOTH]
        values = [_number(metrics[which][key], factor, unit) for which in _BOTH]
        errors.add_row(label, *(text + " *" * star for text, star in zip(values, starred, strict=True)))
    if metrics["truth"]:
        placed = (metrics["tracked"], metrics["tracked"] + metrics["final_later"])
        met = (f"{metrics[which]['pairs']} of {of}" for which, of in zip(_BOTH, placed, strict=True))
        errors.add_row("true poses found", *met)
        errors.add_row("true path", _number(metrics["path_m"], 1.0, "m"), "")
    console.print(errors)
    if any(of_own_length(metrics[which]["t_rel_lengths_m"]) for which in _BOTH):
        console.print(f"* {OWN_LENGTH}", highlight=False, soft_wrap=True)

    latency, cpu, void = metrics["latency_ms"], metrics["cpu_ms_per_frame"], metrics["timings_void"]
    loops = metrics["loops"]
    run = Table(show_header=False, title="run")
    for label, value in (
        ("coverage", f"{_number(metrics['coverage'])} of {metrics['frames']} frames"),
        ("frames not played", f"{metrics['unreadable_frames']} (unreadable, wrong size or stamp)"),
        ("first pose, ready", f"{_number(metrics['first_pose_s'])}, {_number(metrics['ready_s'])} s"),
        ("rate", f"{_number(metrics['fps'])} fps, {metrics['dropped_frames']} dropped"),
        ("latency p50, p99", f"{_number(latency['p50'])}, {_number(latency['p99'])} ms"),
        ("CPU", f"{_number(cpu['total'])} ms a frame"),
        ("memory", f"{_number(metrics['peak_pss_mb']['total'])} MB PSS"),
        ("machine used by others", _number(metrics["foreign_cpu"], 100.0, "%") + (" (timings void)" * void)),
        ("map", f"{metrics['keyframes']} keyframes, {metrics['map_points']} points"),
        (
            "loops",
            f"{loops['accepted']}, right {_number(loops['precision'], 100.0, '%')}, "
            f"up to scale {_number(loops['place_precision'], 100.0, '%')}",
        ),
    ):
        run.add_row(label, value)
    console.print(run)
    if not metrics["monocular"]:
        console.print("depth came from the recording's own sensor: not a monocular run", soft_wrap=True)
    if metrics["truth"]:
        file = metrics["truth_file"]
        named = "" if file in (None, metrics["truth"]) else f" ({file})"  # carried over, where it is BONN's
        console.print(f"scored against {metrics['truth']}{named}", highlight=False, soft_wrap=True)
    if metrics["camera"]:
        found = _found(metrics["camera_found"])
        console.print(f"camera: {metrics['camera']['origin']}{found}", highlight=False, soft_wrap=True)
    for warning in metrics["warnings"]:
        console.print(f"warning: {warning}", highlight=False, soft_wrap=True)
    console.print(f"written to {out}", highlight=False, soft_wrap=True)


def _found(of_camera: dict[str, float | None]) -> str:
    """What the map says of its camera, in words that follow the camera's name."""
    said = {"k1": "k1 {:.4f}", "readout_ms": "rows read over {:.1f} ms"}
    words = [text.format(of_camera[name]) for name, text in said.items() if of_camera[name] is not None]
    return f"; found in the map: {', '.join(words)}" if words else ""


def _number(value: float | None, factor: float = 1.0, unit: str = "") -> str:
    if value is None:
        return "-"
    shown = factor * value
    text = f"{shown:.3g}" if abs(shown) < 999.5 else f"{shown:.0f}"  # KITTI is kilometres long
    return f"{text} {unit}".rstrip()
