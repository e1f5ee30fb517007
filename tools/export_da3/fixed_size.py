"""Lets a network be traced at one image size: what depends on the size alone becomes a constant.

The package computes positions, rotary frequencies and position embeddings anew for each image, with
operators that the exporter does not know (cartesian_prod) or that would cost time at each inference. Within
:func:`recorded` a first, untraced pass keeps each such result under its sizes; a traced pass then finds it
there. The values are the package's own.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from depth_anything_3.model.dinov2.layers.rope import PositionGetter, RotaryPositionEmbedding2D
from depth_anything_3.model.dinov2.vision_transformer import DinoVisionTransformer
from depth_anything_3.model.dpt import DPT
from depth_anything_3.model.dualdpt import DualDPT

Sizes = tuple[int, ...]


@contextmanager
def recorded() -> Iterator[None]:
    """Within it, run the network once untraced, then trace it at the same size."""
    kept: dict[tuple[int, str, Sizes], torch.Tensor] = {}
    originals: list[tuple[type, str, Any]] = []

    def keep(owner: type, name: str, sizes_of: Callable[..., Sizes]) -> None:
        original = getattr(owner, name)
        originals.append((owner, name, original))

        def replacement(self: Any, *args: Any, **kwargs: Any) -> Any:
            key = (id(self), name, tuple(int(size) for size in sizes_of(*args, **kwargs)))
            if key not in kept:
                kept[key] = original(self, *args, **kwargs)
            return kept[key]

        setattr(owner, name, replacement)

    def keep_added(owner: type, name: str) -> None:
        """The same for a method (x, width, height) that adds something of its sizes to x."""
        original = getattr(owner, name)
        originals.append((owner, name, original))

        def replacement(self: Any, x: torch.Tensor, width: int, height: int) -> torch.Tensor:
            key = (id(self), name, (*(int(size) for size in x.shape), int(width), int(height)))
            if key not in kept:
                kept[key] = original(self, torch.zeros_like(x), width, height)
            return x + kept[key]

        setattr(owner, name, replacement)

    keep(PositionGetter, "__call__", lambda batch, height, width, device: (batch, height, width))
    keep(
        RotaryPositionEmbedding2D,
        "_compute_frequency_components",
        lambda dim, length, device, dtype: (dim, length),
    )
    keep(DinoVisionTransformer, "interpolate_pos_encoding", lambda x, width, height: (width, height))
    for head in (DPT, DualDPT):
        keep_added(head, "_add_pos_embed")
    try:
        yield
    finally:
        for owner, name, original in originals:
            setattr(owner, name, original)
