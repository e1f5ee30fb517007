"""A relative network's depth in a metric network's unit, as the nested checkpoint does it, in one graph.

s = <m, d> / <d, d> over the pixels that are not sky and whose confidence is at least the median of those.
Since m is metres * f0 / f, so is s d: the composed network is focal-normalised like its metric half, and
the daemon multiplies by the true camera's f / f0 where the package takes a predicted one.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

SKY_LIMIT = 0.3


def nested_depth(depth: Tensor, confidence: Tensor, metric: Tensor, sky: Tensor) -> Tensor:
    """``depth`` (1, h, w) times the one factor that brings it nearest ``metric`` (1, h, w).

    Where no pixel can be compared the factor is 0, which says that there is no depth.
    """
    ground = sky < SKY_LIMIT
    usable = ground & (confidence >= masked_median(confidence, ground)) & (depth > 0) & (metric > 0)
    weight = usable.to(depth.dtype)
    factor = (weight * metric * depth).sum() / (weight * depth * depth).sum().clamp_min(1e-12)
    return depth * factor


def masked_median(values: Tensor, mask: Tensor) -> Tensor:
    """The median of ``values`` where ``mask``, between the two middle ones where they are even in number.

    In operators that can be exported: the others are sorted to the end.
    """
    flat, chosen = values.reshape(-1), mask.reshape(-1)
    beyond = torch.full_like(flat, 3e38)
    ordered = torch.topk(torch.where(chosen, flat, beyond), flat.numel(), largest=False).values
    count = chosen.to(torch.int64).sum().clamp_min(1)
    low, high = (count - 1) // 2, count // 2
    pair = torch.index_select(ordered, 0, torch.stack([low, high]))
    return 0.5 * (pair[0] + pair[1])


class NestedDepth(nn.Module):
    """:func:`nested_depth` as a module."""

    def forward(self, depth: Tensor, confidence: Tensor, metric: Tensor, sky: Tensor) -> Tensor:
        return nested_depth(depth, confidence, metric, sky)
