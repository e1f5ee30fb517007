"""The long run: a looping recording at 30 Hz, and whether memory, latency and the map stay where they are.

    python tools/soak.py [--minutes 60] [--out build/soak]

Writes report.json and report.md; the exit code is 1 where a bar is not met. Memory counts after the first
ten minutes, or the first third of a shorter run, which then says little: a map that still grows takes memory.
CPU time a pose and what others took of the machine stand beside the latency, by thirds of the run, too: a
latency that grows without them is the daemon's.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import signal
import sys
import tempfile
import time
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from prism_edge.evaluation.resources import cpu_s, machine_cpu, taken_by_others
from prism_edge.geometry.poses import Array, inverse, rotation_angle
from tools.faults_service import Service, Watcher, draw_room, long_recording, one_run, service_config

SETTLED_S = 600.0  # from when on memory counts
SAMPLE_S = 10.0
GROWTH_MB = 3.0
FLAT = 1.2  # p99 latency of the last third by that of the first, at most
SCALE = ("log_scale", "rejected")  # no bar: but a map whose unit has gone is worth a line
SLACK_MS = 2.0  # a difference that small is none
GAP_S = 1.0  # the longest time without a pose
SLOWEST = 100  # poses of which the report says when they came
RATE = 30.0  # pictures a second
LEAST_MIN = 0.6  # four samples, between which three thirds are
WANDER_CM, WANDER_DEG = 2.0, 0.5  # that the place of one and the same picture may move


def main(arguments: list[str] | None = None) -> int:
    """Run, report; returns the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--max-keyframes", type=int, default=600, help="the map's bound (default 600)")
    parser.add_argument("--out", type=Path, default=Path("build/soak"), help="folder of the report")
    args = parser.parse_args(arguments)
    if not args.minutes >= LEAST_MIN:
        parser.error(f"argument --minutes: {LEAST_MIN:g} at least, to be told by thirds, not {args.minutes}")
    args.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="prism-edge-soak-") as folder:
        report = soak(Path(folder), 60.0 * args.minutes, args.max_keyframes, args.out)
    (args.out / "report.json").write_text(json.dumps(report, indent=1) + "\n")
    text = markdown(report)
    (args.out / "report.md").write_text(text)
    print(text)
    return 0 if all(bar["met"] for bar in report["bars"].values()) else 1


def soak(folder: Path, seconds: float, max_keyframes: int, out: Path) -> dict[str, Any]:
    """The run and its figures."""
    room = draw_room(folder)
    recording = long_recording(room, folder / "long", frames=8925)
    config = service_config(str(recording), room, folder / "state", loop=True)
    config = _bounded(config, max_keyframes)
    with contextlib.ExitStack() as stack:
        service = stack.enter_context(Service(folder, config))
        stack.callback(lambda: (out / "daemon.log").write_bytes(service.log.read_bytes()))
        watcher = Watcher(config)
        stack.callback(watcher.close)
        deadline = time.monotonic() + 120.0
        while not watcher.well:
            if time.monotonic() > deadline:
                raise SystemExit(f"soak: error: no poses in two minutes; see {out / 'daemon.log'}")
            time.sleep(0.1)
        begun, first = time.monotonic(), len(watcher.poses)
        samples: list[dict[str, Any]] = []
        while (at := time.monotonic() - begun) < seconds:
            samples.append(
                {
                    "at_s": at,
                    "poses": len(watcher.poses),
                    "cpu_s": _cpu(service),
                    "machine": machine_cpu(),
                    "pss_mb": service.memory_mb(),
                    "anonymous_mb": service.memory_mb("_Anon"),
                    "descriptors": service.descriptors(),
                    "keyframes": _held(watcher),
                    "scale": {k: watcher.health.get("scale", {}).get(k, "nan") for k in SCALE},
                }
            )
            time.sleep(max(0.0, min(SAMPLE_S, begun + seconds - time.monotonic())))
        poses = len(watcher.poses) - first
        costs = by_thirds(samples)
        restarts = {name: row["restarts"] for name, row in watcher.health.items() if "restarts" in row}
        latencies = [(when - begun, ms) for when, ms in list(watcher.latencies) if when >= begun]
        gap, gap_at = watcher.longest_gap_and_when(begun, time.monotonic() - 0.05)
        path = watcher.path[first:]
        code = service.stop()
    settled = min(SETTLED_S, seconds / 3.0)
    starts = path[0][0] if path else 0.0
    wanders = wander([(at, pose) for at, pose in path if at >= starts + settled], len(room.pictures))
    centimetres, degrees = (max((row[k] for row in wanders), default=float("nan")) for k in (0, 1))
    late = [sample for sample in samples if sample["at_s"] >= settled]
    growth, first_mb = _growth(late, "pss_mb")
    anonymous, _ = _growth(late, "anonymous_mb")
    thirds = [
        float(np.percentile([ms for at, ms in latencies if k <= 3.0 * at / seconds < k + 1] or [np.nan], 99))
        for k in range(3)
    ]
    keyframes = max(sample["keyframes"] for sample in samples)
    met = {
        f"PSS grows <= {GROWTH_MB:g} MB after {settled / 60:.1f} min": (
            f"{growth:+.1f} MB, of {first_mb:.0f} MB", growth <= GROWTH_MB
        ),
        "p99 latency stays flat": (
            "by thirds of the run " + ", ".join(f"{ms:.1f}" for ms in thirds) + " ms",
            thirds[2] <= max(FLAT * thirds[0], thirds[0] + SLACK_MS),
        ),
        f"map within {max_keyframes} keyframes": (f"at most {keyframes}", 0 < keyframes <= max_keyframes),
        f"a picture's place stays within {WANDER_CM:g} cm, {WANDER_DEG:g} degrees": (
            f"{centimetres:.2f} cm, {degrees:.2f} degrees", centimetres <= WANDER_CM and degrees <= WANDER_DEG
        ),
        **lasted(gap, restarts, service.exits, code),
        "no NaN published": (str(watcher.not_numbers), not watcher.not_numbers),
    }
    return {
        "seconds": seconds,
        "poses": poses,
        "rate_hz": poses / seconds,
        "longest_gap_s": gap,
        "longest_gap_at_s": gap_at - begun,
        "thirds": costs,
        "growth_mb": growth,
        "anonymous_growth_mb": anonymous,
        "log_scale": _range([float(sample["scale"]["log_scale"]) for sample in samples]),
        "scales_refused": samples[-1]["scale"]["rejected"],
        "growth_mb_by_process": {
            name: round(_growth(late, "pss_mb", name)[0], 2) for name in late[0]["pss_mb"]
        },
        "p99_ms_by_third": thirds,
        "slowest_at_s_ms": sorted(latencies, key=lambda row: -row[1])[:SLOWEST],
        "wander_cm_deg": wanders,
        "samples": samples,
        "bars": {name: {"found": found, "met": bool(ok)} for name, (found, ok) in met.items()},
    }


def markdown(report: dict[str, Any]) -> str:
    """The report for people."""
    thirds = report["thirds"]
    lines = [
        f"{report['seconds'] / 60:.1f} minutes, {report['poses']} poses ({report['rate_hz']:.2f} Hz), "
        f"longest gap {1e3 * report['longest_gap_s']:.0f} ms, after {report['longest_gap_at_s']:.0f} s.",
        "By thirds of the run, other programs and hosts took "
        + ", ".join("?" if t["foreign_cpu"] is None else f"{100 * t['foreign_cpu']:.0f} %" for t in thirds)
        + " of the machine; CPU time a pose was "
        + ", ".join(f"{t['cpu_ms_per_pose']['total']:.1f}" for t in thirds)
        + " ms.",
        "",
        "| bar | found | met |",
        "|---|---|---|",
    ]
    for name, bar in report["bars"].items():
        lines.append(f"| {name} | {bar['found']} | {'yes' if bar['met'] else '**no**'} |")
    by_process = ", ".join(f"{name} {mb:+.1f}" for name, mb in report["growth_mb_by_process"].items())
    anonymous = report["anonymous_growth_mb"]
    low, high = report["log_scale"]
    lines += ["", f"Log scale from {low:.2f} to {high:.2f}, {report['scales_refused']} observations refused."]
    lines += ["", f"Growth by process (MB): {by_process}. Without files' pages: {anonymous:+.1f} MB in all."]
    return "\n".join(lines) + "\n"


def by_thirds(samples: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """CPU time a pose (ms; of each process, and ``total``) and others' share of the machine in each third."""
    ends = [round(k * (len(samples) - 1) / 3) for k in range(4)]
    found = []
    for first, last in pairwise(ends):
        before, after = samples[first], samples[last]
        used: dict[str, float] = {}
        for one, other in pairwise(samples[first : last + 1]):
            for name, seconds in other["cpu_s"].items():
                spent_s = seconds - one["cpu_s"].get(name, 0.0)
                # One that was started again counts from 0.
                used[name] = used.get(name, 0.0) + (spent_s if spent_s >= 0.0 else seconds)
        poses = max(after["poses"] - before["poses"], 1)
        spent = {name: round(1e3 * seconds / poses, 2) for name, seconds in used.items()}
        foreign = taken_by_others(before["machine"], after["machine"], sum(used.values()))
        found.append(
            {
                "cpu_ms_per_pose": {**spent, "total": round(1e3 * sum(used.values()) / poses, 2)},
                "foreign_cpu": foreign,
            }
        )
    return found


def lasted(
    gap_s: float, restarts: dict[str, str], exits: list[int], code: int | None
) -> dict[str, tuple[str, bool]]:
    """Whether it was one run, in which no process and not the service itself was started again."""
    return {
        f"never longer than {GAP_S:g} s without a pose": (f"{gap_s:.3f} s", gap_s <= GAP_S),
        "no process started again": (json.dumps(restarts), set(restarts.values()) == {"0"}),
        "one run, that ends with 0": one_run(exits, code),
    }


def wander(path: list[tuple[float, Array]], pictures: int) -> list[tuple[float, float]]:
    """How far from its first round each later one of a looped recording is: centimetres and degrees.

    ``path`` is (stamp in seconds, world_from_camera) of a recording of so many ``pictures``, at RATE from 0.
    Medians over the pictures that both rounds have; a round that has less than half of them is left out.
    """
    rounds: dict[int, dict[int, Array]] = {}
    for stamp, pose in path:
        number, picture = divmod(round(RATE * stamp), pictures)
        rounds.setdefault(number, {})[picture] = pose
    found = []
    whole = [poses for _, poses in sorted(rounds.items()) if 2 * len(poses) >= pictures]
    for poses in whole[1:]:
        both = [(whole[0][k], pose) for k, pose in poses.items() if k in whole[0]]
        if both:
            moved = [np.linalg.norm(now[:3, 3] - then[:3, 3]) for then, now in both]
            turned = [rotation_angle((inverse(then) @ now)[:3, :3]) for then, now in both]
            found.append((100.0 * float(np.median(moved)), float(np.degrees(np.median(turned)))))
    return found


def _bounded(config: Any, max_keyframes: int) -> Any:
    return replace(config, tracking=replace(config.tracking, max_keyframes=max_keyframes))


def _range(values: list[float]) -> tuple[float, float]:
    known = [value for value in values if np.isfinite(value)] or [float("nan")]
    return min(known), max(known)


def _growth(samples: list[dict[str, Any]], what: str, name: str = "") -> tuple[float, float]:
    """How much memory has grown, of all processes or one, and what it was: MB.

    Medians of ten samples or fewer at both ends, as one moment says little.
    """
    totals = [sum(mb for k, mb in sample[what].items() if name in ("", k)) for sample in samples]
    n = max(1, min(10, len(totals) // 3))
    first = float(np.median(totals[:n]))
    return float(np.median(totals[-n:])) - first, first


def _held(watcher: Watcher) -> int:
    """Keyframes that the tracker's and the backend's map hold, whichever has more; -1 where none says so.

    The backend's snapshot would count the carried poses of culled ones too.
    """
    said = [watcher.health.get(name, {}).get("keyframes", "-1") for name in ("tracker", "backend")]
    return max(map(int, said))


def _cpu(service: Service) -> dict[str, float]:
    used = {name: cpu_s(process.pid) for name, process in service.processes().items()}
    return {name: seconds[0] for name, seconds in used.items() if seconds is not None}


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))  # the daemon ends with us
    sys.exit(main())
