"""What prism-nano is trained to: metric log depth, its edges, its scale, its own error, and places."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F  # noqa: N812

from tools.train_nano.ruler import SEEN_APART, SEEN_TOGETHER

TEMPERATURE = 0.15
RANKING_TEMPERATURE, SHARPNESS = 0.07, 10.0  # of likeness, and of closeness, in the ranking
LEAST_ASKED = 0.25  # closeness of the closest other view, for a view to be asked about
EDGES, SCALE, OWN_ERROR, PLACES = 0.5, 0.5, 0.2, 0.3  # weights, log depth's being 1


def depth_losses(log_depth: Tensor, log_error: Tensor, truth: Tensor) -> dict[str, Tensor]:
    """Means of the parts; ``truth`` (n, h, w) is 0 where there is none, the others (n, 1, h, w)."""
    there = (truth > 0).float()
    residual = (log_depth[:, 0] - truth.clamp(min=1e-3).log()) * there
    size = there.sum().clamp(min=1.0)
    absolute = residual.abs()
    # Laplace's likelihood; the depth itself is left alone, or hard pixels would be given up early.
    own = (absolute.detach() / log_error[:, 0].exp() + log_error[:, 0]) * there
    per_image = residual.sum(dim=(1, 2)) / there.sum(dim=(1, 2)).clamp(min=1.0)
    return {
        "log": absolute.sum() / size,
        "edges": edges(residual, there),
        "scale": per_image.abs().mean(),
        "own": own.sum() / size,
    }


def edges(residual: Tensor, there: Tensor) -> Tensor:
    """Mean absolute differences of the residual between neighbours, at steps of 1, 2, 4 and 8 pixels."""
    total = residual.new_zeros(())
    for step in (1, 2, 4, 8):
        for axis in (1, 2):
            a, b = residual.narrow(axis, step, residual.shape[axis] - step), residual.narrow(
                axis, 0, residual.shape[axis] - step
            )
            both = there.narrow(axis, step, there.shape[axis] - step) * there.narrow(
                axis, 0, there.shape[axis] - step
            )
            total = total + ((a - b).abs() * both).sum() / both.sum().clamp(min=1.0)
    return total / 8.0


def place_loss(descriptor: Tensor, overlap: Tensor) -> Tensor:
    """InfoNCE over a batch: views of one place against views of others; those in between don't count."""
    alike = descriptor @ descriptor.T / TEMPERATURE
    self = torch.eye(len(alike), dtype=torch.bool)
    positive = (overlap >= SEEN_TOGETHER) & ~self
    negative = (overlap <= SEEN_APART) & ~self
    others = alike.masked_fill(~negative, float("-inf")).logsumexp(dim=1, keepdim=True)
    each = F.softplus(others - alike)
    return each[positive].mean() if bool(positive.any()) else alike.sum() * 0.0


def ranking_loss(descriptor: Tensor, closeness: Tensor) -> Tensor:
    """Listwise cross entropy (Cao et al., ICML 2007): the closer a view (n, n), the likelier it is to be.

    Views that are close to no other one ask nothing, but are there to be taken for what they are not.
    """
    self = torch.eye(len(descriptor), dtype=torch.bool)
    alike = (descriptor @ descriptor.T / RANKING_TEMPERATURE).masked_fill(self, -1e4)
    wanted = (SHARPNESS * closeness).masked_fill(closeness < SEEN_APART, -1e4).masked_fill(self, -1e4)
    asked = (closeness.masked_fill(self, 0.0) >= LEAST_ASKED).any(dim=1)
    each = -(wanted.softmax(dim=1) * alike.log_softmax(dim=1)).sum(dim=1)
    return each[asked].mean() if bool(asked.any()) else alike.sum() * 0.0


def total(log_depth: Tensor, log_error: Tensor, descriptor: Tensor, truth: Tensor, overlap: Tensor) -> tuple[
    Tensor, dict[str, float]
]:
    """The weighted sum, and each part for the record."""
    parts = depth_losses(log_depth, log_error, truth)
    parts["places"] = place_loss(descriptor, overlap)
    loss = (
        parts["log"]
        + EDGES * parts["edges"]
        + SCALE * parts["scale"]
        + OWN_ERROR * parts["own"]
        + PLACES * parts["places"]
    )
    return loss, {name: float(value.detach()) for name, value in parts.items()}
