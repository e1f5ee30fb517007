"""Simulated runs drawn at random, played and scored: accuracy and honesty where nothing was chosen.

python tools/random_runs.py --network FILE [--seed 1] [--count 36] [--jobs 2] [--out build/random]

Rooms, rings of rooms and streets; ways by hand, on wheels and with stops; sizes, focal lengths, rates,
speeds, people, noise, blur, exposure and readout, from one seed: the same number gives the same runs. Half of
them are seen with the network given, a quarter each with prism_nano and with exact depth (`--model sensor`:
not monocular). Each is `prism-edge eval --lockstep` in a folder of its own; one that is finished there with
the same settings and versions is not played again.
"""

from __future__ import annotations

import argparse
import json
import random
import subprocess
import sys
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import fmean, geometric_mean
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
if str(ROOT) not in sys.path:  # run from a checkout
    sys.path.insert(0, str(ROOT))

from prism_edge.cli.settings import BUNDLED, whole_above_zero  # noqa: E402
from prism_edge.config import SENSOR  # noqa: E402
from tools.finished_runs import Metrics, finished  # noqa: E402

SIZES = ((640, 480), (640, 480), (320, 240), (752, 480), (1280, 720), (424, 240))
STREET_SIZES = ((1242, 376), (640, 480), (960, 540))
SECONDS, MOST_FRAMES = 15, 500
NETWORK, NANO = "network", BUNDLED


@dataclass(frozen=True)
class Draw:
    """One run: what is seen, and what gives its depth."""

    number: int
    uri: str
    depth: str  # NETWORK, NANO or SENSOR

    @property
    def kind(self) -> str:
        """`room`, `loop` or `street`."""
        return self.uri.split(":")[1].split("?")[0]


def drawn(seed: int, count: int) -> list[Draw]:
    """The first ``count`` runs of a seed."""
    rng = random.Random(seed)
    return [_draw(rng, number) for number in range(count)]


def _draw(rng: random.Random, number: int) -> Draw:
    kind = rng.choice(["room"] * 5 + ["loop"] * 2 + ["street"])
    options: dict[str, Any] = {"seed": rng.randint(100, 999)}
    if kind == "street":
        options |= {"rate": rng.choice([10, 15, 20]), "speed": rng.choice([6, 9, 14])}
        size = rng.choice(STREET_SIZES)
        options["frames"] = rng.choice([350, 500])
    else:
        ways = ["handheld", "handheld", "wheeled"] + (["stops"] if kind == "room" else [])
        options |= {"path": rng.choice(ways), "rate": rng.choice([15, 20, 30, 30, 60])}
        size = rng.choice(SIZES)
        options["frames"] = min(SECONDS * options["rate"], MOST_FRAMES)
        if rng.random() < 0.6:
            options["speed"] = round(rng.uniform(0.15, 0.8 if kind == "room" else 1.3), 2)
        if rng.random() < 0.3:
            options["actors"] = rng.randint(1, 2)
    options["width"], options["height"] = size
    if rng.random() < 0.6:
        options["focal"] = round(size[0] * rng.choice([0.5, 0.6, 0.7, 1.0, 1.2]))
    options |= {name: rng.choice(values) for name, values in _EFFECTS.items()}
    if rng.random() < 0.25:
        options["readout"] = rng.choice([10, 20, 33])
    depth = rng.choice([NETWORK, NETWORK, NANO, SENSOR])
    return Draw(number, f"sim:{kind}?" + "&".join(f"{k}={v}" for k, v in options.items()), depth)


_EFFECTS = {"noise": (0.5, 1, 1, 2), "blur": (0, 1, 1, 2), "exposure": (0, 1, 1, 2)}


def command(draw: Draw, network: str, out: Path) -> list[str]:
    """What `prism-edge` is given."""
    model = network if draw.depth == NETWORK else draw.depth
    return ["eval", draw.uri, "--model", model, "--lockstep", "--out", str(out / f"{draw.number:03}")]


def play(network: str, out: Path, draw: Draw) -> Metrics | None:
    """The metrics of one run; None where it failed, with the reason on stderr."""
    words = command(draw, network, out)
    where = Path(words[-1])
    metrics = finished(where, words)
    if metrics is None:
        program = [sys.executable, "-m", "prism_edge", *words]
        done = subprocess.run(program, cwd=ROOT, capture_output=True, text=True, check=False)
        if done.returncode:
            said = done.stderr.strip().splitlines()
            print(f"{draw.number}: {said[-1] if said else done.returncode} ({draw.uri})", file=sys.stderr)
            return None
        metrics = json.loads((where / "metrics.json").read_text())
    print(f"{draw.number}: done", file=sys.stderr, flush=True)
    return metrics


def line(draw: Draw, metrics: Metrics | None) -> str:
    """A row of the table."""
    start = f"| {draw.number} | `{draw.uri}` | {draw.depth} |"
    if metrics is None:
        return f"{start} failed | | | | | |"
    errors = [metrics[part]["ate_sim3_m"] for part in ("live", "final")]
    shown = ["-" if error is None else f"{100.0 * error:.1f}" for error in errors]
    ratios = ("nees_1s", "scale_log_error_sigmas", "scale_sigma_to_bias")
    shown += ["" if metrics.get(name) is None else f"{metrics[name]:.2f}" for name in ratios]
    return f"{start} {metrics['coverage']:.3f} | {' | '.join(shown)} |"


def summary(runs: Iterable[tuple[Draw, Metrics | None]]) -> list[str]:
    """Averages of those indoors, by what gave their depth."""
    lines = []
    good = [(draw, metrics) for draw, metrics in runs if metrics is not None and draw.kind != "street"]
    for label, depths in (("network and prism_nano", (NETWORK, NANO)), ("exact depth", (SENSOR,))):
        chosen = [metrics for draw, metrics in good if draw.depth in depths]
        if not chosen:
            continue
        live, final = (_mean_cm(chosen, part) for part in ("live", "final"))
        nees = [m["nees_1s"] for m in chosen if m.get("nees_1s")]
        honest = f"NEES mean {fmean(nees):.2f}, geometric {geometric_mean(nees):.2f}, " if nees else ""
        poses = [m["nees_pose"] for m in chosen if m.get("nees_pose")]
        by_itself = f"; of poses geometric {geometric_mean(poses):.2f}" if poses else ""
        least = min(m["coverage"] for m in chosen)
        lines.append(
            f"- indoors, {label}, {len(chosen)} runs: least coverage {least:.3f}, "
            f"Sim(3) live {live}, final {final} cm (geometric means); {honest}"
            f"above 2 {sum(n > 2.0 for n in nees)}, below 0.5 {sum(n < 0.5 for n in nees)}{by_itself}"
        )
    return lines


def _mean_cm(runs: list[Metrics], part: str) -> str:
    """Geometric mean of the Sim(3) errors that are there, and how many are not."""
    errors = [100.0 * run[part]["ate_sim3_m"] for run in runs if run[part]["ate_sim3_m"]]
    mean = f"{geometric_mean(errors):.1f}" if errors else "-"
    return mean if len(errors) == len(runs) else f"{mean} ({len(runs) - len(errors)} without)"


def main(arguments: list[str] | None = None) -> int:
    """Play them, print the table; 1 where a run failed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--network", required=True, metavar="FILE", help="ONNX file or registry name")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--count", type=whole_above_zero, default=36)
    parser.add_argument("--jobs", type=whole_above_zero, default=2, help="runs at a time")
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "random")
    args = parser.parse_args(arguments)
    # Played from the checkout, wherever we are.
    network = str(Path(args.network).absolute()) if Path(args.network).is_file() else args.network
    draws = drawn(args.seed, args.count)
    with ThreadPoolExecutor(args.jobs) as pool:
        metrics = list(pool.map(partial(play, network, args.out.absolute() / str(args.seed)), draws))
    print("| | run | depth | coverage | live, cm | final, cm | NEES | scale's error, σ | σ over bias |")
    print("|---|---|---|---|---|---|---|---|---|")
    for draw, found in zip(draws, metrics, strict=True):
        print(line(draw, found))
    print("", *summary(zip(draws, metrics, strict=True)), sep="\n")
    return int(None in metrics)


if __name__ == "__main__":
    sys.exit(main())
