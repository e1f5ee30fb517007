"""What loops are worth: sequences with them and without, in lockstep, side by side.

    python tools/measure_loops.py --model FILE [SEQUENCE ...] [--truth FILE.tum] [--out DIR]

SEQUENCE is anything that `prism-edge eval` takes; by default a simulated walk through eight rooms and back,
46 m with one late return (`sim:loop?seed=1`; some minutes). --truth is for all of them. Prints a table in
Markdown: accepted loops, how many are right, final errors with and without over the frames that both runs
have placed, what is gained, and how many frames those are. Where no loop was accepted the run without would
be the same to the last digit (lockstep): it is not made. Files go to DIR (default: build/loops).
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from prism_edge.cli.main import main as prism_edge
from prism_edge.errors import EvaluationError
from prism_edge.evaluation.scores import ate
from prism_edge.evaluation.trajectory import Trajectory, paired, read_tum

ROOT = Path(__file__).resolve().parents[1]
DEFAULT = "sim:loop?seed=1"
HEAD = (
    "| sequence | loops | right | final Sim(3) without | with | gained | frames: both, without, with |\n"
    "|---|---|---|---|---|---|---|"
)


def run(sequence: str, model: str, out: Path, loops: bool, truth: str = "") -> dict[str, Any]:
    """One evaluation; its metrics. Raises SystemExit with the exit code of one that fails."""
    words = ["eval", sequence, "--model", model, "--lockstep", "--out", str(out)]
    words += [] if loops else ["--ablate", "loop"]
    words += ["--truth", truth] if truth else []
    with redirect_stdout(sys.stderr):
        code = prism_edge(words)
    if code:
        raise SystemExit(code)
    metrics: dict[str, Any] = json.loads((out / "metrics.json").read_text())
    return metrics


def row(sequence: str, loops: dict[str, Any], folders: tuple[Path, Path]) -> str:
    """One line of the table; the ``folders`` are of the runs with ``loops`` and without."""
    (after, before), frames = on_common_frames(folders)
    gained = "-" if not after or not before else f"{100.0 * (1.0 - after / before):.0f} %"
    right = "-" if loops["precision"] is None else f"{100.0 * loops['precision']:.0f} %"
    cells = (sequence, str(loops["accepted"]), right, _metres(before), _metres(after), gained, frames)
    return f"| {' | '.join(cells)} |"


def on_common_frames(folders: tuple[Path, Path]) -> tuple[list[float | None], str]:
    """Final errors (m) of two runs over the frames that both have placed, and how many each has.

    A loop places parts of the map that lie nowhere without it: they would count for one run alone.
    """
    runs = [_path(folder / "final.tum") for folder in folders]
    both = np.intersect1d(runs[0].stamps, runs[1].stamps)
    counts = f"{len(both)}, {len(runs[1])}, {len(runs[0])}"
    truth, errors = _path(folders[0] / "truth.tum"), []
    for run in runs:
        found, true = paired(run.at(np.flatnonzero(np.isin(run.stamps, both))), truth)
        errors.append(ate(found.positions, true.positions, with_scale=True))
    return errors, counts


def _path(file: Path) -> Trajectory:
    """What a run wrote; nothing where it had nothing to write."""
    try:
        return read_tum(file)
    except EvaluationError:
        return Trajectory.of([])


def _metres(value: float | None) -> str:
    return "-" if value is None else f"{100.0 * value:.2f} cm"


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description="Sequences with and without loop closure.")
    parser.add_argument("sequence", nargs="*", default=[DEFAULT])
    parser.add_argument("--model", required=True)
    parser.add_argument("--truth", default="")
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "loops")
    arguments = parser.parse_args()
    print(HEAD)
    for sequence in arguments.sequence:
        name = re.sub(r"\W+", "_", sequence).strip("_")
        model, out, truth = arguments.model, arguments.out, arguments.truth
        closed = without = out / f"{name}-with"
        loops = run(sequence, model, closed, True, truth)["loops"]
        if loops["accepted"]:
            without = out / f"{name}-without"
            run(sequence, model, without, False, truth)
        print(row(sequence, loops, (closed, without)), flush=True)


if __name__ == "__main__":
    main()
