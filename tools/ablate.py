#!/usr/bin/env python3
"""The paper's two ablation tables on recorded sequences: every part switched off in turn, in lockstep.

    python tools/ablate.py [--shared FOLDER] [--out DIR] [--seeds 0 1 2] [--most N] [--table static|dynamic]
    python tools/ablate.py RECORDING... --model MODEL [--camera FILE] [--truth FILE.tum]... [--out DIR]
        [--seeds 0 1 2] [--most N]

The second is the static table for recordings of one's own, against their own truth or what --truth names,
once for each RECORDING, in their order. The --camera is all the recordings'. RECORDING is a folder or a
video, MODEL as for `prism-edge eval`. FOLDER (default: `shared` beside the checkout) holds data/ and
models/. Files go to DIR/<sequence>/<part>-<seed> (default: build/ablation), and a run that is there, of the
same settings, versions and files, is not repeated: stop it when you like, and go on later; --most ends it
after so many runs. With each seed the map's corrections come with another delay (lockstep.map_lag), which
should matter as little: random numbers alone change nothing. All parts are run with the first seed before
any with the second, and one that fails is named and passed over. The dynamic recordings are made by
tools/make_distractors.py, once. Printed is what there is so far: live ATE after SE(3) and Sim(3) alignment,
median of the seeds, the mean over the sequences, and its difference to the full system's; then the SE(3)
errors of each part and of the full system over the frames that both have placed. Runs that would be made
otherwise now are in the tables until they are repeated, and counted below.
docs/ABLATION.md keeps a copy.
Exit code 1: runs are missing, or would be made otherwise; 8: some failed.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import time
from collections import Counter
from contextlib import redirect_stdout, suppress
from dataclasses import dataclass
from pathlib import Path
from statistics import mean, median

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
if str(ROOT) not in sys.path:  # run from a checkout
    sys.path.insert(0, str(ROOT))

from prism_edge.cli.main import main as prism_edge  # noqa: E402
from prism_edge.cli.settings import whole_from_zero  # noqa: E402
from prism_edge.config import ABLATIONS  # noqa: E402
from prism_edge.errors import PrismError  # noqa: E402
from prism_edge.evaluation.scores import score  # noqa: E402
from prism_edge.evaluation.trajectory import Trajectory, read_tum  # noqa: E402
from prism_edge.named_path import named_path  # noqa: E402
from tools import make_distractors  # noqa: E402
from tools.benchmark import as_named, path_name  # noqa: E402
from tools.finished_runs import differences, metrics_there  # noqa: E402
from tools.true_poses import own_truth, why_unscored  # noqa: E402

NETWORK = "models/fastdepth_nyu_224.onnx"
FULL = ""  # nothing switched off
LAGS = (6, 4, 2, 8, 3, 5)  # of seeds 0, 1, 2 ...; the first is the default
MOST_TRACKED = 97.0  # per cent of the frames: with fewer, a cell of the table says so
OWN = "own recordings"
STATIC_PARTS = (FULL, *ABLATIONS)
DYNAMIC_PARTS = (FULL, "dsug", "consistency", "dsug+consistency")


@dataclass(frozen=True)
class Sequence:
    """A recording below the shared folder, or anywhere; ``distractors`` seeds what is composited into it."""

    name: str
    folder: str
    truth: str = ""
    distractors: int | None = None
    model: str = ""  # as for `prism-edge eval`; empty: NETWORK
    camera: str = ""  # likewise; empty: the recording's own


KITCHEN = ("data/7scenes_redkitchen/seq-01", "data/7scenes_redkitchen/sfm_reference.tum")
HOSPITAL = "data/tartanair_hospital"
TABLES: dict[str, tuple[tuple[str, ...], tuple[Sequence, ...]]] = {
    "static": (
        STATIC_PARTS,
        (
            Sequence("redkitchen", *KITCHEN),
            Sequence("new_tsukuba", "data/new_tsukuba"),
            Sequence("tartanair_hospital", HOSPITAL),
        ),
    ),
    "dynamic": (
        DYNAMIC_PARTS,
        (
            *(Sequence(f"redkitchen_moving_{n}", *KITCHEN, n) for n in range(4)),
            *(Sequence(f"tartanair_moving_{n}", HOSPITAL, "", n) for n in range(4)),
        ),
    ),
}


@dataclass(frozen=True)
class Common:
    """Errors (cm) over the frames that two runs have both placed and that have a true pose."""

    frames: int
    full: float
    without: float


def parts_of(table: str) -> list[str]:
    """The configurations of a table that this version can run."""
    return [part for part in TABLES[table][0] if set(part.split("+")) <= {FULL, *ABLATIONS}]


def label(part: str) -> str:
    """A row's heading."""
    return "full system" if part == FULL else "without " + " and ".join(part.split("+"))


def place(out: Path, sequence: Sequence, part: str, seed: int) -> Path:
    """Where a run's files are."""
    return out / sequence.name / f"{part or 'full'}-{seed}"


def folder_of(shared: Path, out: Path, sequence: Sequence) -> Path:
    """The folder to play, be it made already or not."""
    return shared / sequence.folder if sequence.distractors is None else out / "recordings" / sequence.name


def recording(shared: Path, out: Path, sequence: Sequence) -> Path:
    """The same, made first where it is a dynamic one. Raises RuntimeError where that fails."""
    static, made = shared / sequence.folder, folder_of(shared, out, sequence)
    if sequence.distractors is None:
        return static
    if not (made / "distractors.json").is_file():
        half = made.with_name(made.name + ".half")  # what is cut off is not gone on with
        shutil.rmtree(half, ignore_errors=True)
        words = [str(static), str(half), "--seed", str(sequence.distractors)]
        words += ["--poses", str(shared / sequence.truth)] if sequence.truth else []
        with redirect_stdout(sys.stderr):
            if make_distractors.main(words):
                raise RuntimeError(f"{sequence.name} can't be made")
        shutil.rmtree(made, ignore_errors=True)
        half.rename(made)
    return made


def command(shared: Path, out: Path, sequence: Sequence, part: str, seed: int) -> list[str]:
    """What `prism-edge` is given for one run."""
    model = sequence.model or str(shared / NETWORK)
    words = ["eval", str(folder_of(shared, out, sequence)), "--model", model, "--lockstep"]
    words += ["--seed", str(seed), "--set", f"lockstep.map_lag={LAGS[seed % len(LAGS)]}"]
    words += ["--out", str(place(out, sequence, part, seed))]
    words += ["--camera", sequence.camera] if sequence.camera else []
    words += ["--truth", str(shared / sequence.truth)] if sequence.truth else []
    for name in part.split("+") if part else ():
        words += ["--ablate", name]
    return words


def play(shared: Path, out: Path, sequence: Sequence, part: str, seed: int) -> None:
    """One evaluation in lockstep, be there anything to score. Raises RuntimeError where it fails."""
    recording(shared, out, sequence)
    where = place(out, sequence, part, seed)
    before = _written_ns(where)
    with redirect_stdout(sys.stderr):
        code = prism_edge(command(shared, out, sequence, part, seed))
    if code == 130:  # Ctrl-C
        raise SystemExit(code)
    ended = code == 8 and _written_ns(where) != before  # and not for what kept it from beginning
    if code and not (ended and (metrics_there(where) or {}).get("unscored")):
        raise RuntimeError(f"{sequence.name}, {label(part)}, seed {seed}: eval ended with code {code}")


def _written_ns(where: Path) -> int | None:
    """When a run's metrics were written; None: there are none."""
    try:
        return (where / "metrics.json").stat().st_mtime_ns
    except OSError:
        return None


Figures = dict[int, float]  # by seed


def figures(out: Path, sequence: Sequence, part: str, seeds: list[int], key: str) -> Figures:
    """One live figure of each seed that has it, in hundredths: centimetres, per cent."""
    found: Figures = {}
    for seed in seeds:
        metrics = metrics_there(place(out, sequence, part, seed)) or {}
        try:
            value = metrics[key] if key == "coverage" else metrics["live"][key]
        except (KeyError, TypeError):
            continue  # not run yet, cut off, void or unscored
        if value is not None:
            found[seed] = 100.0 * float(value)
    return found


def _middle(found: Figures) -> str:
    return f"{median(found.values()):.1f}" if found else "-"


def _tracked(found: Figures) -> str:
    """What is said of a run that lost its way."""
    share = median(found.values()) if found else 100.0
    return f" ({share:.0f} %)" if share < MOST_TRACKED else ""


def _average(rows: list[Figures], beside: list[Figures]) -> tuple[float, float] | None:
    """Means over the sequences of two rows' medians of the seeds that both have; None where one has none."""
    pairs = [
        (median(a[seed] for seed in common), median(b[seed] for seed in common))
        for a, b in zip(rows, beside, strict=True)
        if (common := a.keys() & b.keys())
    ]
    if len(pairs) < len(rows):
        return None
    return mean(a for a, _ in pairs), mean(b for _, b in pairs)


def table(name: str, out: Path, seeds: list[int]) -> str:
    """A table in Markdown, with a dash where runs are missing."""
    sequences = TABLES[name][1]
    heads = " | ".join(s.name for s in sequences)
    rule = "|---" * (len(sequences) + 2) + "|"
    lines = [f"| {name}: live SE(3) / Sim(3), cm | {heads} | mean SE(3) |", rule]
    whole = [figures(out, s, FULL, seeds, "ate_se3_m") for s in sequences]
    counts: set[int] = set()
    for part in parts_of(name):
        se3, sim3, tracked = (
            [figures(out, s, part, seeds, key) for s in sequences]
            for key in ("ate_se3_m", "ate_sim3_m", "coverage")
        )
        counts |= {len(found) for found in se3 if found}
        cells = [
            f"{_middle(a)} / {_middle(b)}{_tracked(c)}" for a, b, c in zip(se3, sim3, tracked, strict=True)
        ]
        both = _average(se3, whole)
        text = "-" if both is None else f"{both[0]:.1f}"
        if both is not None and part != FULL:
            text += f" ({both[0] - both[1]:+.1f})"
        lines.append(f"| {label(part)} | {' | '.join(cells)} | {text} |")
    if counts:
        lines.append(f"\nMedians of {' to '.join(map(str, sorted({min(counts), max(counts)})))} seed(s).")
    return "\n".join(lines)


def truth_of(shared: Path, sequence: Sequence) -> Trajectory | None:
    """The true path of a recording; None where it isn't there."""
    if sequence.truth:
        return read_tum(shared / sequence.truth) if (shared / sequence.truth).is_file() else None
    with suppress(PrismError):  # `eval` says why
        known = own_truth(str(shared / sequence.folder))
        return known if len(known) else None
    return None


def on_common_frames(out: Path, truth: Trajectory, sequence: Sequence, part: str, seed: int) -> Common | None:
    """Live SE(3) errors of the full system and without ``part`` where both have a pose; None for no runs."""
    folders = [place(out, sequence, name, seed) for name in (FULL, part)]
    if any(metrics_there(folder) is None for folder in folders):
        return None
    try:
        full, without = (read_tum(folder / "live.tum") for folder in folders)
    except (OSError, PrismError):
        return None
    stamps = np.intersect1d(full.stamps, without.stamps)
    scores = [score(run.at(np.flatnonzero(np.isin(run.stamps, stamps))), truth) for run in (full, without)]
    errors = [each.ate_se3_m for each in scores]
    if errors[0] is None or errors[1] is None:
        return None
    return Common(scores[0].pairs, 100.0 * errors[0], 100.0 * errors[1])


def common_table(name: str, shared: Path, out: Path, seed: int) -> str:
    """In Markdown: each part against the full system over the frames that both have placed, one seed."""
    sequences = TABLES[name][1]
    truths = [truth_of(shared, s) for s in sequences]
    heads = " | ".join(s.name for s in sequences)
    title = f"{name}, frames that both have: live SE(3) without / full, cm (frames)"
    lines = [f"| {title} | {heads} | mean |", "|---" * (len(sequences) + 2) + "|"]
    for part in parts_of(name)[1:]:
        found = [
            None if truth is None else on_common_frames(out, truth, sequence, part, seed)
            for sequence, truth in zip(sequences, truths, strict=True)
        ]
        cells = [f"{c.without:.1f} / {c.full:.1f} ({c.frames})" if c else "-" for c in found]
        there = [c for c in found if c]
        whole = "-"
        if len(there) == len(found):
            without, full = mean(c.without for c in there), mean(c.full for c in there)
            whole = f"{without:.1f} / {full:.1f} ({100.0 * (full / without - 1.0):+.0f} %)"
        lines.append(f"| {label(part)} | {' | '.join(cells)} | {whole} |")
    return "\n".join(lines)


def runs_of(names: list[str], seeds: list[int]) -> list[tuple[Sequence, str, int]]:
    """All runs of the tables: what is cut short has all parts with the first seeds."""
    return [
        (sequence, part, seed)
        for seed in seeds
        for name in names
        for sequence in TABLES[name][1]
        for part in parts_of(name)
    ]


def missing(names: list[str], shared: Path, out: Path, seeds: list[int]) -> list[tuple[Sequence, str, int]]:
    """Runs that are not there, or would come out of other settings, versions or files now."""
    return [
        run
        for run in runs_of(names, seeds)
        if (metrics := metrics_there(place(out, *run))) is None
        or differences(place(out, *run), command(shared, out, *run), metrics)
    ]


def note(names: list[str], shared: Path, out: Path, seeds: list[int]) -> str:
    """What the runs in the tables have that they would not have now; empty where nothing."""
    found: Counter[str] = Counter()
    others = there = 0
    for run in runs_of(names, seeds):
        metrics = metrics_there(place(out, *run))
        if metrics is not None:
            apart = differences(place(out, *run), command(shared, out, *run), metrics)
            found.update(apart)
            there, others = there + 1, others + bool(apart)
    most = ", ".join(f"{what} ({count})" for what, count in found.most_common(8))
    return f"{others} of these {there} runs would be made otherwise now, by: {most}." if others else ""


def own_sequences(args: argparse.Namespace) -> tuple[Sequence, ...]:
    """Recordings of one's own, by the ends of their paths.

    Raises ValueError where two end alike or one has two truths, and for truths that are not one for each.
    """
    if len(args.truth) not in (0, len(args.recordings)):
        raise ValueError("--truth is given once for each RECORDING, in their order, or not at all")
    for file in args.truth:
        read_tum(named_path(str(file)))  # before it fails in every run
    truths = [str(as_named(file)) for file in args.truth] or [""] * len(args.recordings)
    pairs = dict.fromkeys(zip(map(as_named, args.recordings), truths, strict=True))
    named = [Sequence(path_name(f), str(f), truth, None, args.model, args.camera) for f, truth in pairs]
    if len({sequence.name for sequence in named}) < len(named):
        raise ValueError("two recordings have names that end alike: run them with different --out")
    return tuple(named)


def main(arguments: list[str] | None = None) -> int:
    """Returns the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("recordings", metavar="RECORDING", nargs="*", type=Path)
    parser.add_argument("--model", metavar="MODEL", help="with recordings of one's own: as for `eval`")
    parser.add_argument("--camera", metavar="FILE", default="", help="camera file of all of them, or auto")
    parser.add_argument(
        "--truth", metavar="FILE.tum", type=Path, action="append", default=[], help="one for each, in order"
    )
    parser.add_argument("--shared", metavar="FOLDER", type=Path, default=ROOT.parent / "shared")
    parser.add_argument("--out", metavar="DIR", type=Path, default=ROOT / "build" / "ablation")
    parser.add_argument("--seeds", metavar="N", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--most", metavar="N", type=whole_from_zero, default=10**6, help="runs at most")
    parser.add_argument("--table", choices=("static", "dynamic"), action="append")
    args = parser.parse_args(arguments)
    shared, out = args.shared.resolve(), args.out.resolve()
    if bool(args.recordings) != bool(args.model) or (args.recordings and args.table):
        parser.error("RECORDING and --model go together, and without --table")
    if (args.camera or args.truth) and not args.recordings:
        parser.error("--camera and --truth go with RECORDING: the tables' recordings have their own")
    if args.recordings:
        try:
            TABLES[OWN] = STATIC_PARTS, own_sequences(args)
        except (ValueError, PrismError) as error:
            parser.error(str(error))
        for sequence in TABLES[OWN][1]:
            if not sequence.truth and (why := why_unscored(sequence.folder)):
                print(f"ablate: warning: {why}: no errors", file=sys.stderr)
    elif args.most and not (shared / NETWORK).is_file():
        print(f"ablate: error: {shared / NETWORK} is not there; see --shared", file=sys.stderr)
        return 2
    names = [OWN] if args.recordings else args.table or ["static", "dynamic"]
    wanted = missing(names, shared, out, args.seeds)[: args.most]
    failed = 0
    for count, (sequence, part, seed) in enumerate(wanted, 1):
        started = time.monotonic()
        try:
            play(shared, out, sequence, part, seed)
        except RuntimeError as error:
            failed += 1
            print(f"ablate: error: {error}", file=sys.stderr)
            continue
        spent = f"seed {seed}: {time.monotonic() - started:.0f} s"
        print(f"[{count}/{len(wanted)}] {sequence.name}, {label(part)}, {spent}", file=sys.stderr, flush=True)
    for name in names:
        print(table(name, out, args.seeds), end="\n\n", flush=True)
        print(common_table(name, shared, out, args.seeds[0]), end="\n\n", flush=True)
    if said := note(names, shared, out, args.seeds):
        print(said)
    return 8 if failed else 1 if missing(names, shared, out, args.seeds) else 0


if __name__ == "__main__":
    sys.exit(main())
