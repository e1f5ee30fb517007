"""How good a network is on worlds that it never saw: depth, scale, its own error, places."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from tools.train_nano.network import Nano
from tools.train_nano.pictures import Views
from tools.train_nano.ruler import FOUND, SEEN_TOGETHER

MOST = 600  # views looked at, spread over all worlds
_AT_ONCE = 30


@dataclass(frozen=True)
class Verdict:
    """Figures over views: see :meth:`words`."""

    absrel: float
    within_125: float
    scale_mean: float  # mean over views of log (median true / predicted)
    scale_spread: float  # standard deviation of the same
    world_spread: float  # of its means over worlds: what never averages out in one place
    error_order: float  # rank correlation of predicted and real error over pixels
    error_ratio: float  # mean real over mean predicted error
    error_median: float  # middle expected relative error
    recall: float  # share of views whose likeliest other view shows the same place, of those that have one

    def words(self) -> str:
        """One line."""
        return (
            f"AbsRel {self.absrel:.3f}, within 1.25 {self.within_125:.3f}, log scale {self.scale_mean:+.3f} "
            f"± {self.scale_spread:.3f} (worlds {self.world_spread:.3f}), own error order "
            f"{self.error_order:.2f} ratio {self.error_ratio:.2f}, recall@1 {self.recall:.3f}"
        )


@torch.no_grad()
def judge(network: Nano, views: Views, width: int, height: int, most: int = MOST) -> Verdict:
    """Judges on ``most`` whole, unspoilt views at a size; a pair stays together, or it could not be found."""
    network.eval()
    pairs = np.linspace(0, views.pose_count // 2 - 1, min(most, views.pose_count) // 2).astype(int)
    rows = np.stack([2 * pairs, 2 * pairs + 1], axis=1).ravel()
    absrel, within, scale, descriptors, real, expected = [], [], [], [], [], []
    for start in range(0, len(rows), _AT_ONCE):
        batch = views.whole(rows[start : start + _AT_ONCE], width, height)
        log_depth, log_error, descriptor = (part.numpy() for part in network(torch.from_numpy(batch.image)))
        descriptors.append(descriptor)
        for predicted, error, truth in zip(log_depth[:, 0], log_error[:, 0], batch.depth, strict=True):
            there = truth > 0
            ratio = np.log(truth[there]) - predicted[there]
            absrel.append(np.mean(np.abs(np.exp(-ratio) - 1)))
            within.append(np.mean(np.abs(ratio) < np.log(1.25)))
            scale.append(np.median(ratio))
            real.append(np.abs(ratio)[::29])
            expected.append(np.exp(error[there])[::29])
    worlds = views.world[rows]
    logs = np.array(scale)
    each_world = [logs[worlds == world].mean() for world in np.unique(worlds)]
    real_error, own = np.concatenate(real), np.concatenate(expected)
    alike = np.concatenate(descriptors) @ np.concatenate(descriptors).T
    np.fill_diagonal(alike, -np.inf)
    overlap = views.shared(rows)
    np.fill_diagonal(overlap, 0)
    asked = overlap.max(axis=1) >= SEEN_TOGETHER
    found = overlap[np.arange(len(rows)), alike.argmax(axis=1)] >= FOUND
    return Verdict(
        absrel=float(np.mean(absrel)),
        within_125=float(np.mean(within)),
        scale_mean=float(logs.mean()),
        scale_spread=float(logs.std()),
        world_spread=float(np.std(each_world)),
        error_order=float(np.corrcoef(_ranks(real_error), _ranks(own))[0, 1]),
        error_ratio=float(real_error.mean() / own.mean()),
        error_median=float(np.median(own)),
        recall=float(found[asked].mean()),
    )


def _ranks(values: np.ndarray) -> np.ndarray:
    return np.argsort(np.argsort(values)).astype(np.float64)
