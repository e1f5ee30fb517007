#!/usr/bin/env python3
"""Runs dataset folders through `prism-edge eval`; result tables in Markdown beside the paper's figures.

    python tools/benchmark.py FOLDER... --model MODEL [--lockstep] [--runs N] [--frames N] [--camera FILE]
        [--out DIR]

FOLDER is any TUM RGB-D, BONN, 7-Scenes or KITTI odometry sequence. Each is played N times (default 1; medians
count), in real time or lockstep; run n has seed n - 1. Files go to DIR/<folder>-<mode>-<n> (default:
build/benchmark), and a run that is finished there with the same settings, versions, truth and files of camera
and networks, after the recording's tables were written, is not repeated: stop it when you like, and go on
later. The tables say which were. A folder that fails has the reason in its line, and the others go on. Tables
go to stdout, all else to stderr. Exit code 1: a folder has failed.
"""

from __future__ import annotations

import argparse
import io
import json
import os
import re
import sys
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass, field, replace
from pathlib import Path
from statistics import median

ROOT = Path(__file__).resolve().parents[1]
if str(ROOT) not in sys.path:  # run from a checkout
    sys.path.insert(0, str(ROOT))

from prism_edge.cli.main import main as prism_edge  # noqa: E402
from prism_edge.cli.settings import whole_above_zero  # noqa: E402
from prism_edge.depth import NESTED  # noqa: E402
from prism_edge.errors import PrismError  # noqa: E402
from prism_edge.evaluation.metrics import versions  # noqa: E402
from prism_edge.evaluation.scores import of_own_length  # noqa: E402
from prism_edge.evaluation.table import OWN_LENGTH  # noqa: E402
from prism_edge.named_path import named_path  # noqa: E402
from prism_edge.sources.open import find_listing  # noqa: E402
from prism_edge.sources.sim import is_simulated  # noqa: E402
from tools.accuracy import at  # noqa: E402
from tools.finished_runs import (  # noqa: E402
    Metrics,
    finished,
    frames_with_a_pose,
    others_used_the_machine,
)
from tools.published_figures import NOTES, Published, dataset_of, published  # noqa: E402

OTHER = "Other folders"
_CONTROLS = re.compile(r"\x1b\[[0-?]*[ -/]*[@-~]")  # what a progress bar tells a terminal
# Columns; ATE in the dataset's unit.
OURS = (
    *("frames", "path, m", "coverage", "true poses found", "live, UNIT", "final, UNIT"),
    *("live t_rel, %", "live r_rel, deg/100 m"),
)
UNKNOWN_LENGTH = "† Of a sequence whose number of frames is not noted here: see that the folder has it all."
PAPERS = ("*paper*: ATE, UNIT", "*paper*: t_rel, %")


@dataclass
class Row:
    """One folder: what it holds, and what came of it."""

    folder: Path
    dataset: str
    runs: list[Metrics] = field(default_factory=list)
    failure: str = ""
    reused: int = 0  # of the runs
    most: int | None = None  # frames that were asked for; None: all

    def is_whole(self, paper: Published) -> bool:
        """Whether each run may be of the whole sequence that the paper has a figure of."""
        return all(paper.fits(run["frames"], self.most) for run in self.runs)


class _Overheard(io.StringIO):
    """Passes everything on to stderr, and keeps it."""

    def __init__(self) -> None:
        super().__init__()
        self._out = sys.stderr

    def write(self, text: str) -> int:
        self._out.write(text)
        return super().write(text)

    def flush(self) -> None:
        self._out.flush()

    def isatty(self) -> bool:
        return self._out.isatty()

    def last_line(self) -> str:
        """The last line that says something."""
        text = _CONTROLS.sub("", self.getvalue())
        lines = [line.strip() for line in text.splitlines() if line.strip()]
        return lines[-1].removeprefix("prism-edge: error: ") if lines else ""


def row_of(folder: Path) -> Row:
    """What a folder holds, as far as that can be seen without playing it."""
    try:
        return Row(folder, dataset_of(find_listing(folder).layout, folder))
    except (PrismError, OSError):
        return Row(folder, OTHER)  # `eval` says why when it is played


def as_named(folder: Path) -> Path:
    """Absolute, and by the name that was given, as a dataset is known by it: a link keeps its own."""
    return Path(os.path.abspath(named_path(str(folder))))


def path_name(folder: Path) -> str:
    """The end of a folder's path, as a name for what came of it."""
    return "_".join(part for part in folder.parts[-3:] if part != folder.anchor)


def place(out: Path, folder: Path, mode: str, run: int) -> Path:
    """Where a run's files are."""
    return out / f"{path_name(folder)}-{mode}-{run}"


def command(folder: Path, args: argparse.Namespace, run: int) -> list[str]:
    """What `prism-edge` is given for one run."""
    words = ["eval", str(folder), "--model", args.model, "--seed", str(run - 1)]
    words += ["--out", str(place(args.out, folder, args.mode, run))]
    words += ["--camera", args.camera] if args.camera else []
    words += ["--frames", str(args.frames)] if args.frames else []
    return [*words, "--lockstep"] if args.mode == "lockstep" else words


def play(row: Row, args: argparse.Namespace, run: int) -> int:
    """One run into its row, or why there is none; returns `eval`'s exit code."""
    where, words = place(args.out, row.folder, args.mode, run), command(row.folder, args, run)
    metrics = finished(where, words, unscored=True)
    if metrics is not None:
        print(f"reused: {where}", file=sys.stderr)
        if metrics.get("unscored"):
            row.failure = f"the run that was there already can't be scored: {metrics['unscored']}"
            return 8
        row.reused += 1
    else:
        heard = _Overheard()
        with redirect_stderr(heard), redirect_stdout(heard):
            code = prism_edge(words)
        if code:
            row.failure = heard.last_line() or f"eval ended with code {code}"
            return code
        metrics = json.loads((where / "metrics.json").read_text())
    row.runs.append(metrics)
    return 0


def _figure(row: Row, figure: Callable[[Metrics], float | None], digits: str = ".1f") -> str:
    """Median over a row's runs; a dash unless all of them have the figure."""
    known = [value for value in map(figure, row.runs) if value is not None]
    return format(median(known), digits) if known and len(known) == len(row.runs) else "-"


def _both(row: Row, which: str, factor: float) -> str:
    return " / ".join(_figure(row, at(which, key, factor=factor)) for key in ("ate_sim3_m", "ate_se3_m"))


def _of_own_length(row: Row) -> bool:
    """Whether a run's t_rel is over less than KITTI's lengths."""
    return any(of_own_length(run["live"].get("t_rel_lengths_m", [])) for run in row.runs)


def _drift(row: Row, key: str) -> str:
    """Live t_rel or r_rel, starred where it isn't KITTI's."""
    figure = _figure(row, at("live", key), ".2f")
    return figure + "\\*" * (figure != "-" and _of_own_length(row))


def _met(row: Row) -> str:
    """Live and final poses that have a true one at their time, of the frames that have such poses."""
    paths = (("live", "pairs"), ("final", "pairs"), ("tracked",))
    live, final, tracked = (_figure(row, at(*path), ".0f") for path in paths)
    posed = _figure(row, frames_with_a_pose, ".0f")
    if posed != tracked:
        return f"{live} of {tracked} and {final} of {posed}"
    return f"{live} of {tracked}" if live == final else f"{live} and {final} of {tracked}"


def _coverage(row: Row) -> str:
    """Share of the frames that were tracked, and how many never reached the tracker for what they are."""
    refused = _figure(row, at("unreadable_frames"), ".0f")
    return _figure(row, at("coverage"), ".3f") + (f" ({refused} not played)" * (refused not in ("0", "-")))


def _number(value: float | None, factor: float = 1.0) -> str:
    return "-" if value is None else f"{factor * value:g}"


def _name(row: Row) -> str:
    """What a row is called: 7-Scenes has a seq-01 in each scene."""
    return str(Path(*row.folder.parts[-2:]))


def line(row: Row) -> str:
    """A folder's line in its dataset's table."""
    paper = published(row.dataset, row.folder)
    name = _name(row) + (f" ({paper.sequence})" if paper else "")
    outdoors = row.dataset.startswith("KITTI")
    factor, paper_factor = (1.0, 0.01) if outdoors else (100.0, 1.0)
    cells = [name]
    if row.failure:
        cells += [f"failed: {row.failure.replace('|', '/')}", *[""] * (len(OURS) - 1)]
    else:
        cells += [
            _figure(row, at("frames"), ".0f"),
            _figure(row, at("path_m"), ".1f"),
            _coverage(row),
            _met(row),
            _both(row, "live", factor),
            _both(row, "final", factor),
            _drift(row, "t_rel_percent"),
            _drift(row, "r_rel_deg_per_100m"),
        ]
    if paper is None or not (row.runs and row.is_whole(paper)):
        cells += ["-", "-"]
    else:
        mark = UNKNOWN_LENGTH[0] * (paper.frames is None)
        ate = " / ".join(_number(value, paper_factor) for value in (paper.sim3_cm, paper.se3_cm))
        cells += [ate + mark, _number(paper.t_rel_percent)]
    return f"| {' | '.join(cells)} |"


def warnings(row: Row) -> list[str]:
    """What its runs warn of, each once; a run of an earlier build has none, and may be of another commit."""
    said = [f"{_name(row)}: {text}." for run in row.runs for text in run.get("warnings", [])]
    busy = [run for run in row.runs if others_used_the_machine(run)]
    if busy:
        said.append(
            f"{_name(row)}: others used the machine during {len(busy)} of {len(row.runs)} run(s), which "
            "costs frames, and so coverage and accuracy."
        )
    if row.reused:
        said.append(
            f"{_name(row)}: {row.reused} of {len(row.runs)} run(s) were there already, of this version "
            f"({versions()['prism_edge']}) but maybe of another commit."
        )
    return list(dict.fromkeys(said))


def _below(rows: list[Row]) -> list[str]:
    """What is to be said of a table's rows."""
    said = [f"\\* {OWN_LENGTH}."] if any(map(_of_own_length, rows)) else []
    papers = [(row, published(row.dataset, row.folder)) for row in rows]
    if any(paper and paper.frames is None and row.is_whole(paper) for row, paper in papers):
        said.append(UNKNOWN_LENGTH)
    for row, paper in papers:
        if paper and not row.is_whole(paper):
            frames = _figure(row, at("frames"), ".0f")
            theirs = "all" if paper.frames is None else paper.frames
            whose = f"{_name(row)} has {frames} frames, and the paper's figures are of {theirs}"
            said.append(f"{whose}: they are left out.")
    said += [text for row in rows for text in warnings(row)]
    # A set: the table's dataset has one note, which is of the paper's figures.
    return said + sorted({NOTES[row.dataset] for row, paper in papers if paper and row.dataset in NOTES})


def model_name(model: str) -> str:
    """A network as it is called, without the folders that it, or each of a pair, lies in."""
    pair = model.removeprefix(NESTED)
    names = ",".join(Path(part).name for part in pair.split(",")) if pair != model else Path(model).name
    return model[: len(model) - len(pair)] + names


def tables(rows: list[Row], args: argparse.Namespace) -> str:
    """A table for each dataset, in the order in which they were given."""
    mode = "lockstep" if args.mode == "lockstep" else "real time"
    parts = [
        f"`prism_edge` with {model_name(args.model)}, {mode}, {args.runs} run(s) each (medians). ATE RMSE: "
        "Sim(3) / SE(3). The columns marked *paper* are what the PRISM-SLAM paper prints for its own system "
        "with DA3 on a GPU; they were not measured here, and it doesn't say whether they are live or final."
    ]
    heads = ("sequence", *OURS, *PAPERS)
    for dataset in dict.fromkeys(row.dataset for row in rows):
        unit = "m" if dataset.startswith("KITTI") else "cm"
        of_it = [row for row in rows if row.dataset == dataset]
        parts.append(
            f"### {dataset}\n\n"
            f"| {' | '.join(heads)} |\n{'|---' * len(heads)}|\n".replace("UNIT", unit)
            + "\n".join(map(line, of_it))
            + "".join(f"\n\n{text}" for text in _below(of_it))
        )
    return "\n\n".join(parts)


def _settings(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folders", metavar="FOLDER", nargs="+", type=Path)
    parser.add_argument("--model", metavar="MODEL", required=True, help="as for `prism-edge eval`")
    parser.add_argument("--lockstep", dest="mode", action="store_const", const="lockstep", default="realtime")
    parser.add_argument("--runs", metavar="N", type=whole_above_zero, default=1)
    parser.add_argument("--frames", metavar="N", type=whole_above_zero, help="of each folder the first N")
    parser.add_argument("--camera", metavar="FILE", help="camera file of all the folders, or auto")
    parser.add_argument("--out", metavar="DIR", type=Path, default=ROOT / "build" / "benchmark")
    args = parser.parse_args(arguments)
    args.out = args.out.resolve()
    if simulated := [str(folder) for folder in args.folders if is_simulated(str(folder))]:
        parser.error(f"{simulated[0]} is no folder: `prism-edge eval` scores simulated worlds")
    args.folders = list(dict.fromkeys(map(as_named, args.folders)))
    places = [place(args.out, folder, args.mode, 1) for folder in args.folders]
    if len(set(places)) < len(places):
        parser.error("two folders have names that end alike: run them with different --out")
    return args


def main(arguments: list[str] | None = None) -> int:
    """Run, tabulate; returns the exit code."""
    args = _settings(arguments)
    rows = [replace(row_of(folder), most=args.frames) for folder in args.folders]
    begun: list[Row] = []
    for number, row in enumerate(rows, start=1):
        begun.append(row)
        code = 0
        for run in range(1, args.runs + 1):
            print(f"[{number}/{len(rows)}] {row.folder}, run {run} of {args.runs}", file=sys.stderr)
            code = play(row, args, run)
            if code:
                break
        if code == 130:  # Ctrl-C
            row.failure = "interrupted"
            break
    print(tables(begun, args), flush=True)
    return 1 if any(row.failure for row in begun) else 0


if __name__ == "__main__":
    sys.exit(main())
