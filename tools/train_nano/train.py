"""Trains prism-nano on rendered views; a checkpoint of each stage is kept up to date as it goes.

    python -m tools.train_nano.train DATA OUT [--walks DATA] [--held-out DATA] [--steps N,N,...] [--seed N]

Six stages, or the first few of them. Small pictures come first: most of what a room looks like is learned
there at half the price. Then pictures of the network's own size at a constant learning rate, and then the
rate goes down to nothing. The fourth and fifth are the second and third once more, with wider crops, which
are nearer to the whole pictures that the network is for. The sixth takes strewn views and views of walks by
turns, nearly whole, and ends with the rate at nothing. Where the rate is constant, a stage can be stopped
at any checkpoint as if it had been asked for no more steps. The weights that are kept are an exponential
mean over the steps.
"""

from __future__ import annotations

import argparse
import copy
import math
import sys
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import cv2
import torch
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from tools.train_nano.judge import judge
from tools.train_nano.losses import total
from tools.train_nano.network import Nano
from tools.train_nano.pictures import Batch, Views
from tools.train_nano.ruler import HEIGHT, WIDTH

FULL = (WIDTH, HEIGHT)
SIZES = ((96, 80), FULL, FULL, FULL, FULL, FULL)  # of a stage's pictures
# Learning rate at a stage's beginning and end.
RATES = ((3e-3, 1.2e-3), (1.2e-3, 1.2e-3), (1.2e-3, 1e-5), (1.2e-3, 1.2e-3), (1.2e-3, 1e-5), (1e-3, 1e-5))
NARROWEST = (0.55, 0.55, 0.55, 0.7, 0.7, 0.85)  # a stage's narrowest crop, as a share of the view's width
WARM_UP = {0: 200, 3: 50, 5: 30}  # steps of a stage: where the rate jumps up
KEEP = 0.998  # of the running mean, a step
REPORT, CHECK = 50, 250  # steps between lines, and between checkpoints
AHEAD = 3  # batches made in advance


class Mean:
    """The exponential mean of a network's weights and of its batch statistics."""

    def __init__(self, network: Nano) -> None:
        self.network = copy.deepcopy(network).eval()
        self.count = 0

    @torch.no_grad()
    def take(self, network: Nano) -> None:
        """Adds one step; the first steps weigh more, so that the beginning is soon forgotten."""
        self.count += 1
        keep = min(KEEP, (1 + self.count) / (10 + self.count))
        for own, new in zip(self.network.state_dict().values(), network.state_dict().values(), strict=True):
            if own.dtype.is_floating_point:
                own.lerp_(new, 1 - keep)
            else:
                own.copy_(new)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("data", type=Path, help="folder that tools.train_nano.render wrote")
    parser.add_argument("out", type=Path, help="folder for checkpoints")
    parser.add_argument("--walks", type=Path, help="folder that tools.train_nano.walks wrote, for stage 6")
    parser.add_argument("--held-out", type=Path, help="such a folder of other worlds, looked at on the way")
    parser.add_argument("--steps", default="2500,2500,1000", help="of the stages (default %(default)s)")
    parser.add_argument("--stop", type=int, default=0, help="end the last stage after so many of its steps")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--resume", type=Path, metavar="FILE", help="checkpoint of a finished stage")
    arguments = parser.parse_args()
    torch.manual_seed(arguments.seed)
    torch.set_num_threads(arguments.threads)
    cv2.setNumThreads(1)
    arguments.out.mkdir(parents=True, exist_ok=True)
    steps = [int(word) for word in arguments.steps.split(",")]
    if len(steps) > len(SIZES):
        parser.error(f"--steps {arguments.steps}: there are {len(SIZES)} stages")
    if not 0 <= arguments.stop <= steps[-1]:
        parser.error(f"--stop {arguments.stop}: the last stage has {steps[-1]} steps")
    network, first = Nano().to(memory_format=torch.channels_last), 0
    mean = Mean(network)
    if arguments.resume:
        earlier = torch.load(arguments.resume, weights_only=True)
        first = earlier["stage"] + 1
        load(network, earlier["network"])
        load(mean.network, earlier["mean"])
        mean.count = earlier["count"]
    others = Views(arguments.held_out) if arguments.held_out else None
    views = Views(arguments.data)
    walks = Views(arguments.walks) if arguments.walks else None
    for folder, pictures in ((arguments.data, views), (arguments.walks, walks)):
        try:
            if pictures is not None:
                pictures.check_worlds()
        except ValueError as error:
            parser.error(f"{folder}: {error}")
    if len(steps) == len(SIZES) and walks is None:
        parser.error("the last stage takes --walks")
    for stage in range(first, len(steps)):
        folders = [views]
        if walks is not None and stage + 1 == len(SIZES):
            folders = [views, walks]
            mean.count = 0  # other pictures: what was learned before them is to be forgotten sooner
        stop = arguments.stop if stage + 1 == len(steps) and arguments.stop else steps[stage]
        run_stage(stage, steps[stage], stop, network, mean, folders, others, arguments.seed, arguments.out)


def load(network: Nano, weights: dict[str, Tensor]) -> None:
    """A checkpoint's weights; of one whose descriptor was made otherwise, all but that."""
    own = {name: w for name, w in network.state_dict().items() if name.startswith("place.")}
    stored = {name: w.shape for name, w in weights.items() if name.startswith("place.")}
    if stored != {name: w.shape for name, w in own.items()}:
        weights = {name: w for name, w in weights.items() if name not in stored} | own
    network.load_state_dict(weights)


def run_stage(
    stage: int,
    steps: int,
    stop: int,
    network: Nano,
    mean: Mean,
    folders: list[Views],
    others: Views | None,
    seed: int,
    out: Path,
) -> None:
    """One stage of ``steps`` steps, or its first ``stop``; ``mean`` is what counts afterwards."""
    width, height = SIZES[stage]

    def batch(step: int) -> Batch:
        return folders[step % len(folders)].batch(width, height, NARROWEST[stage], seed, stage, step)

    decayed = [p for p in network.parameters() if p.ndim > 1]
    plain = [p for p in network.parameters() if p.ndim <= 1]
    groups = [{"params": decayed, "weight_decay": 0.02}, {"params": plain, "weight_decay": 0.0}]
    optimiser = torch.optim.AdamW(groups)
    console = Console()
    bar = Progress(
        TextColumn(f"stage {stage + 1}, {width}x{height}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[loss]}"),
        console=console,
    )
    with bar, ThreadPoolExecutor(1) as pool:
        task = bar.add_task("", total=steps, loss="")
        coming: list[Future[Batch]] = [pool.submit(batch, step) for step in range(min(AHEAD, steps))]
        running: dict[str, float] = {}
        for step in range(stop):
            example = coming.pop(0).result()
            if step + AHEAD < steps:
                coming.append(pool.submit(batch, step + AHEAD))
            image, truth, overlap = (torch.from_numpy(part) for part in example)
            network.train()
            answer = network(image.contiguous(memory_format=torch.channels_last))
            loss, parts = total(*answer, truth, overlap)
            for group in optimiser.param_groups:
                group["lr"] = rate(stage, step, steps)
            optimiser.zero_grad(set_to_none=True)
            loss.backward()
            torch.nn.utils.clip_grad_norm_(network.parameters(), 5.0)
            optimiser.step()
            mean.take(network)
            for name, value in parts.items():
                running[name] = running.get(name, value) * 0.98 + value * 0.02
            text = " ".join(f"{name} {value:.3f}" for name, value in running.items())
            bar.update(task, advance=1, loss=text)
            if (step + 1) % REPORT == 0:
                console.print(f"stage {stage + 1} step {step + 1}: {text}", soft_wrap=True)
            if (step + 1) % CHECK == 0 or step + 1 == stop:
                save(network, mean, stage, out / f"stage{stage + 1}.pt")
                if others is not None:
                    words = judge(mean.network, others, width, height).words()
                    console.print(f"  held out: {words}", soft_wrap=True)


def rate(stage: int, step: int, steps: int) -> float:
    """Learning rate: up in a straight line at the very beginning, then down along cosines."""
    first, last = RATES[stage]
    cosine = last + (first - last) * 0.5 * (1.0 + math.cos(math.pi * step / steps))
    return cosine * min(1.0, (step + 1) / WARM_UP.get(stage, 1))


def save(network: Nano, mean: Mean, stage: int, path: Path) -> None:
    """Writes a checkpoint; what was there stays until the new one is whole."""
    temporary = path.with_suffix(".part")
    weights = {"network": network.state_dict(), "mean": mean.network.state_dict()}
    torch.save({**weights, "count": mean.count, "stage": stage}, temporary)
    temporary.replace(path)


if __name__ == "__main__":
    main()
