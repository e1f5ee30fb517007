"""What loops are worth: sequences with them and without, in lockstep, side by side.

    python tools/measure_loops.py --model FILE [SEQUENCE ...] [--truth FILE.tum] [--out DIR]

SEQUENCE is anything that `prism-edge eval` takes; by default a simulated walk through eight rooms and back,
46 m with one late return (`sim:loop?seed=1`; some minutes). --truth is for all of them. Prints a table in
Markdown: accepted loops, how many are right, final errors with and without, and what is gained. Where no loop
was accepted the run without would be the same to the last digit (lockstep): it is not made. Files go to DIR
(default: build/loops).
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from prism_edge.cli.main import main as prism_edge

ROOT = Path(__file__).resolve().parents[1]
DEFAULT = "sim:loop?seed=1"
HEAD = (
    "| sequence | loops | right | final Sim(3) without | with | gained |\n|---|---|---|---|---|---|"
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


def row(sequence: str, with_loops: dict[str, Any], without: dict[str, Any]) -> str:
    """One line of the table."""
    loops = with_loops["loops"]
    after, before = (m["final"]["ate_sim3_m"] for m in (with_loops, without))
    gained = "-" if not after or not before else f"{100.0 * (1.0 - after / before):.0f} %"
    right = "-" if loops["precision"] is None else f"{100.0 * loops['precision']:.0f} %"
    cells = (sequence, str(loops["accepted"]), right, _metres(before), _metres(after), gained)
    return f"| {' | '.join(cells)} |"


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
        closed = run(sequence, model, out / f"{name}-with", True, truth)
        accepted = closed["loops"]["accepted"]
        open_ = run(sequence, model, out / f"{name}-without", False, truth) if accepted else closed
        print(row(sequence, closed, open_), flush=True)


if __name__ == "__main__":
    main()
