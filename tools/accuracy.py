"""Runs the recorded sequences through the daemon and holds every figure against its bar.

    python tools/accuracy.py [--shared FOLDER] [--out DIR] [--runs N] [--only SEQUENCE]... [--keep]

FOLDER (default: `shared` beside the checkout) holds data/ and models/. redkitchen is played in real time
N times (default 3; medians count), the others once in lockstep: some minutes, on a machine that does nothing
else. Each run's files go to DIR/<sequence>-<run> (default: build/accuracy), the tables in Markdown to stdout,
all else to stderr. --keep doesn't repeat runs that are there already, of the same settings, versions and
files, on a machine that did nothing else; an earlier commit's are kept. Exit code 1: a bar is missed, or
timings are void because others used the machine meanwhile; else that of the `eval` that failed.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from contextlib import redirect_stdout
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from statistics import median
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from prism_edge.cli.main import main as prism_edge
from prism_edge.config import DepthConfig
from prism_edge.depth import open_network
from prism_edge.evaluation.scores import score
from prism_edge.evaluation.trajectory import Trajectory, read_tum
from prism_edge.sources.truth import read_truth
from tools.finished_runs import Metrics, finished, frames_with_a_pose
from tools.measure_depth import mean_ratio, measure

ROOT = Path(__file__).resolve().parents[1]
NETWORK = "models/fastdepth_nyu_224.onnx"


@dataclass(frozen=True)
class Bar:
    """One figure of metrics.json and what it may be at most (or at least)."""

    name: str
    figure: Callable[[Metrics], float | None]
    limit: float
    unit: str = ""
    at_least: bool = False
    binding: bool = True  # False: missing it is reported, and no failure
    worst: bool = False  # of the runs counts, not their median

    def met(self, value: float | None) -> bool:
        """A figure that couldn't be computed misses its bar."""
        if value is None:
            return False
        return value >= self.limit if self.at_least else value <= self.limit


def at(*path: str, factor: float = 1.0) -> Callable[[Metrics], float | None]:
    """The figure at a path of keys, times ``factor``; None where it is missing or null."""

    def figure(metrics: Metrics) -> float | None:
        value: Any = metrics
        for key in path:
            value = value.get(key) if value is not None else None
        return None if value is None else factor * float(value)

    return figure


def halves_differ_percent(of: str) -> Callable[[Metrics], float | None]:
    """By how much the larger of the two halves' scales, live or final, exceeds the smaller."""

    def figure(metrics: Metrics) -> float | None:
        halves = metrics[of]["scale_ratio_halves"]
        if halves is None or None in halves:
            return None
        return 100.0 * (max(halves) / min(halves) - 1.0)

    return figure


def off_network_percent(metrics: Metrics) -> float | None:
    """By how much the final scale differs from the network's mean ratio on the recording."""
    ratio = metrics["final"]["scale_ratio"]
    return None if ratio is None else 100.0 * abs(float(ratio) / float(metrics["network_ratio"]) - 1.0)


def slower_beside_global(metrics: Metrics) -> float | None:
    """p99 of latency while everything is adjusted over that of all other poses."""
    p99 = metrics["adjustments"]["latency_p99_ms"]
    during, otherwise = p99["during_global"], p99["otherwise"]
    return None if during is None or not otherwise else float(during) / float(otherwise)


def judged_percent(every: int = 1) -> Callable[[Metrics], float | None]:
    """Share of the frames with a pose that the final figures rest on; ``every`` so manieth has truth."""

    def figure(metrics: Metrics) -> float | None:
        posed = frames_with_a_pose(metrics)
        return 100.0 * every * float(metrics["final"]["pairs"]) / posed if posed else None

    return figure


def dropped_percent(metrics: Metrics) -> float:
    """Share of the recording's frames that were never tracked."""
    return 100.0 * float(metrics["dropped_frames"]) / max(int(metrics["frames"]), 1)


@dataclass(frozen=True)
class Sequence:
    """One recording, how it is run, and its bars."""

    name: str
    folder: str  # below the shared folder
    bars: tuple[Bar, ...]
    truth: str = ""  # below the shared folder; empty: the sequence's own
    lockstep: bool = True


def whole(every: int = 1) -> tuple[Bar, ...]:
    """What every run owes: else its errors are those of a part, or of a map that wasn't finished."""
    return (
        Bar("tracked frames that are judged", judged_percent(every), 95.0, "%", at_least=True, worst=True),
        Bar("tracked frames without a final pose", at("final_missing"), 0, worst=True),
        Bar("the map was finished", at("final_settled"), 1, at_least=True, worst=True),
    )


RIGHT_LOOPS = at("loops", "precision", factor=100)
BESIDE_GLOBAL = at("adjustments", "latency_p99_ms", "during_global")

SEQUENCES = (
    Sequence(
        "redkitchen",
        "data/7scenes_redkitchen/seq-01",
        (
            Bar("coverage", at("coverage"), 0.98, at_least=True),
            Bar("frames a second", at("fps"), 29.0, at_least=True),
            Bar("dropped frames", dropped_percent, 2.0, "%"),
            Bar("first pose", at("first_pose_s"), 0.5, "s"),
            Bar("ready", at("ready_s"), 2.0, "s"),
            Bar("live ATE Sim(3)", at("live", "ate_sim3_m", factor=100), 1.3, "cm"),
            Bar("live ATE Sim(3)", at("live", "ate_sim3_m", factor=100), 2.0, "cm", worst=True),
            Bar("live ATE SE(3)", at("live", "ate_se3_m", factor=100), 4.0, "cm"),
            Bar("final ATE Sim(3)", at("final", "ate_sim3_m", factor=100), 1.0, "cm"),
            Bar("final ATE SE(3)", at("final", "ate_se3_m", factor=100), 3.0, "cm"),
            Bar("final scale off the network's by", off_network_percent, 3.0, "%"),
            Bar("live scales of the halves differ by", halves_differ_percent("live"), 3.0, "%"),
            Bar("final scales of the halves differ by", halves_differ_percent("final"), 3.0, "%"),
            Bar("sigma of the scale over the network's bias", at("scale_sigma_to_bias"), 1.3),
            Bar("error of the scale", at("scale_log_error_sigmas"), 2.0, "sigma"),
            Bar("NEES over 1 s", at("nees_1s"), 2.0),
            Bar("NEES over 1 s, at least", at("nees_1s"), 0.5, at_least=True),
            Bar("live ATE Sim(3), own truth", at("own_truth", "ate_sim3_m", factor=100), 6.5, "cm"),
            Bar("loops accepted", at("loops", "accepted"), 3, at_least=True),
            Bar("loops that are right", RIGHT_LOOPS, 100.0, "%", at_least=True, worst=True),
            Bar("CPU, tracker", at("cpu_ms_per_frame", "tracker"), 10.0, "ms a frame"),
            Bar("CPU, all processes", at("cpu_ms_per_frame", "total"), 45.0, "ms a frame"),
            Bar("latency p50", at("latency_ms", "p50"), 15.0, "ms"),
            Bar("latency p99", at("latency_ms", "p99"), 40.0, "ms"),
            Bar("latency p99 beside a global adjustment", BESIDE_GLOBAL, 40.0, "ms"),
            Bar("the same over that of all others", slower_beside_global, 1.5),
            Bar("window adjustment, median", at("adjustments", "window_ms", "p50"), 250.0, "ms"),
            Bar("longest global adjustment", at("adjustments", "global_cpu_s"), 3.0, "s of CPU"),
            Bar("memory (PSS)", at("peak_pss_mb", "total"), 550.0, "MB"),
            *whole(every=10),
        ),
        truth="data/7scenes_redkitchen/sfm_reference.tum",
        lockstep=False,
    ),
    Sequence(
        "new_tsukuba",
        "data/new_tsukuba",
        (
            Bar("coverage", at("coverage"), 0.95, at_least=True),
            Bar("final ATE Sim(3)", at("final", "ate_sim3_m", factor=100), 1.2, "cm"),
            *whole(),
        ),
    ),
    Sequence(
        "kitti_turn",
        "data/kitti_turn",
        (
            Bar("coverage", at("coverage"), 0.9, at_least=True),
            Bar("live ATE Sim(3)", at("live", "ate_sim3_m"), 0.5, "m"),
            *whole(),
        ),
    ),
    Sequence(
        "tartanair_hospital",
        "data/tartanair_hospital",
        (
            Bar("coverage", at("coverage"), 0.8, at_least=True),
            Bar("live ATE Sim(3)", at("live", "ate_sim3_m"), 1.0, "m", binding=False),
            Bar("final ATE Sim(3)", at("final", "ate_sim3_m"), 0.3, "m"),
            *whole(),
        ),
    ),
)


def table(sequence: Sequence, runs: list[Metrics]) -> tuple[str, bool]:
    """Markdown for one sequence, and whether every binding bar is met and every timing valid."""
    lines = [
        f"### {sequence.name} ({'lockstep' if sequence.lockstep else 'real time'}, {len(runs)} run(s))",
        "",
        "| figure | bar | median | least to most | |",
        "|---|---|---|---|---|",
    ]
    good = True
    for bar in sequence.bars:
        known = [value for value in map(bar.figure, runs) if value is not None]
        worst = min if bar.at_least else max
        value = (worst(known) if bar.worst else median(known)) if len(known) == len(runs) else None
        met = bar.met(value)
        good = good and (met or not bar.binding)
        sign = "≥" if bar.at_least else "≤"
        cells = (
            f"{bar.name}, worst" if bar.worst else bar.name,
            f"{sign} {bar.limit:g} {bar.unit}".rstrip(),
            "-" if value is None else f"{value:.3g}",
            f"{min(known):.3g} to {max(known):.3g}" if known else "-",
            "met" if met else "**missed**",
        )
        lines.append(f"| {' | '.join(cells)} |")
    void = sum(bool(metrics["timings_void"]) for metrics in runs)
    if void and not sequence.lockstep:
        good = False
        lines += ["", f"Timings of {void} run(s) are void: others used the machine meanwhile."]
    return "\n".join(lines), good


class RunFailedError(Exception):
    """`eval` failed; what it said is on stderr, its exit code is here."""

    def __init__(self, code: int) -> None:
        super().__init__(code)
        self.code = code


def play(sequence: Sequence, shared: Path, out: Path, keep: bool) -> Metrics:
    """One evaluation, as `prism-edge eval` does it; returns its metrics. Raises RunFailedError."""
    words = command(sequence, shared, out)
    metrics = finished(out, words) if keep else None
    if metrics is None:
        with redirect_stdout(sys.stderr):
            code = prism_edge(words)
        if code:
            raise RunFailedError(code)
        metrics = json.loads((out / "metrics.json").read_text())
    if sequence.truth:
        own = read_truth(str(shared / sequence.folder))
        if own is not None:
            metrics["network_ratio"] = network_ratio(shared / sequence.folder, shared / NETWORK)
            metrics["own_truth"] = score(read_tum(out / "live.tum"), Trajectory(*own)).as_dict()
    return metrics


@lru_cache(maxsize=1)
def network_ratio(folder: Path, model: Path) -> float:
    """True depth over the network's on a recording with a sensor's; some seconds."""
    scores, _ = measure(folder, open_network(str(model), DepthConfig(model=str(model))), every=3)
    return mean_ratio(scores)


def command(sequence: Sequence, shared: Path, out: Path) -> list[str]:
    """What `prism-edge` is given for one run."""
    words = ["eval", str(shared / sequence.folder), "--model", str(shared / NETWORK), "--out", str(out)]
    words += ["--truth", str(shared / sequence.truth)] if sequence.truth else []
    return [*words, "--lockstep"] if sequence.lockstep else words


def main(arguments: list[str] | None = None) -> int:
    """Run, tabulate; returns the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--shared", metavar="FOLDER", type=Path, default=ROOT.parent / "shared")
    parser.add_argument("--out", metavar="DIR", type=Path, default=ROOT / "build" / "accuracy")
    parser.add_argument("--runs", metavar="N", type=int, choices=range(1, 100), default=3)
    parser.add_argument("--only", metavar="SEQUENCE", action="append", choices=[s.name for s in SEQUENCES])
    parser.add_argument("--keep", action="store_true")
    args = parser.parse_args(arguments)
    shared, out = args.shared.resolve(), args.out.resolve()
    for needed in ("data", NETWORK):
        if not (shared / needed).exists():
            print(f"accuracy: error: {shared / needed} is not there; see --shared", file=sys.stderr)
            return 2
    all_good = True
    for sequence in SEQUENCES:
        if args.only and sequence.name not in args.only:
            continue
        numbers = range(1, (1 if sequence.lockstep else args.runs) + 1)
        try:
            runs = [play(sequence, shared, out / f"{sequence.name}-{n}", args.keep) for n in numbers]
        except RunFailedError as error:
            print(f"accuracy: error: {sequence.name}: eval ended with code {error.code}", file=sys.stderr)
            return error.code
        text, good = table(sequence, runs)
        all_good = all_good and good
        print(f"{text}\n", flush=True)
    return 0 if all_good else 1


if __name__ == "__main__":
    sys.exit(main())
