"""Trains the descriptor alone, on features of a finished network: many places at once, for little.

    python -m tools.train_nano.places CHECKPOINT OUT DATA [DATA...] [--steps N] [--seed N]

Each view is spoilt once and its features are kept; depth stays as it is. A batch holds many views of a few
worlds, so that most of what a view must be told from is the same room's other end, or the next room. The
descriptor is to rank them by closeness: overlap, and how near they were taken.
"""

from __future__ import annotations

import argparse
import math
import sys
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from rich.progress import track
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from tools.train_nano.losses import ranking_loss
from tools.train_nano.network import Nano
from tools.train_nano.pictures import Views
from tools.train_nano.train import Mean, load

NARROWEST = 0.85  # crop, as a share of a view's width
BATCH, MOST = 256, 64  # views, and most of one world
RATE, DECAY = 2e-3, 0.05
_AT_ONCE = 40


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("out", type=Path, help="checkpoint to write")
    parser.add_argument("data", type=Path, nargs="+", help="folders that render and walks wrote")
    parser.add_argument("--steps", type=int, default=1500)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    torch.manual_seed(arguments.seed)
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    earlier = torch.load(arguments.checkpoint, weights_only=True)
    network = Nano()
    load(network, earlier["mean"])
    folders = [Views(folder) for folder in arguments.data]
    kept = [features(network, views, arguments.seed) for views in folders]
    train(network, folders, kept, arguments.steps, arguments.seed)
    torch.save({**earlier, "mean": network.state_dict()}, arguments.out)


@torch.no_grad()
def features(network: Nano, views: Views, seed: int) -> Tensor:
    """What the descriptor of each view is made of (n, c, h, w), halves."""
    network.eval()
    parts = []
    for start in track(range(0, views.pose_count, _AT_ONCE), description="features"):
        rows = range(start, min(start + _AT_ONCE, views.pose_count))
        pictures = np.stack([views.spoilt(row, NARROWEST, seed, 200) for row in rows])
        parts.append(network.place_maps(torch.from_numpy(pictures)).half())
    return torch.cat(parts)


def train(network: Nano, folders: list[Views], kept: list[Tensor], steps: int, seed: int) -> None:
    """Changes the network's descriptor, and nothing else of it."""
    mean = Mean(network)
    place = network.place.train()
    optimiser = torch.optim.AdamW(place.parameters(), lr=RATE, weight_decay=DECAY)
    running = 0.0
    for step in track(range(steps), description="places"):
        rng = np.random.default_rng((seed, 201, step))
        which = int(rng.choice(len(folders), p=[len(k) / sum(map(len, kept)) for k in kept]))
        rows = choose(folders[which], rng)
        loss = ranking_loss(place(kept[which][rows].float()), torch.from_numpy(folders[which].close(rows)))
        for group in optimiser.param_groups:
            group["lr"] = RATE * min(1.0, (step + 1) / 30) * 0.5 * (1 + math.cos(math.pi * step / steps))
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        optimiser.step()
        mean.take(network)
        running = loss.item() if not step else 0.97 * running + 0.03 * loss.item()
        if (step + 1) % 100 == 0:
            print(f"step {step + 1}: {running:.3f}", flush=True)
    network.load_state_dict(mean.network.state_dict())


def choose(views: Views, rng: np.random.Generator) -> NDArray[np.int64]:
    """Rows of a batch: whole pairs of a few worlds."""
    rows: list[int] = []
    for world in rng.permutation(np.unique(views.world)):
        own = views.of_world(int(world))
        pairs = rng.choice(len(own) // 2, min(MOST, len(own)) // 2, replace=False)
        rows += [int(own[2 * pair + k]) for pair in pairs for k in (0, 1)]
        if len(rows) >= BATCH:
            break
    return np.array(rows[:BATCH])


if __name__ == "__main__":
    main()
