"""Messages as the other processes would send them, with what a test does not say filled in."""

from __future__ import annotations

from dataclasses import MISSING, fields, replace
from typing import Any, TypeVar

import numpy as np

from prism_edge.messages import Depth, Keyframe, KeyframeImage, MapUpdate, Scale, Tracked

T = TypeVar("T")


def blank(kind: type[T], **given: Any) -> T:
    """A message with what is given; arrays that are not have no rows."""
    empty = {
        f.name: np.zeros([max(n, 0) for n in f.metadata["shape"]], f.metadata["dtype"])
        for f in fields(kind)  # type: ignore[arg-type]
        if "dtype" in f.metadata and f.default_factory is MISSING
    }
    return kind(**(empty | given))


def tick(index: int, keyframe: int = -1) -> Tracked:
    """A frame that was tracked, and perhaps became a keyframe."""
    return Tracked(index, index * 33_000_000, 0, "ok", True, keyframe, 0, np.eye(4))


def depth_of(
    asked: Keyframe | KeyframeImage, depth: np.ndarray, image_to_depth: np.ndarray, /, **changes: object
) -> Depth:
    """The network's answer to a keyframe: depth (h, w) in metres."""
    made = blank(
        Depth,
        keyframe=asked.keyframe if isinstance(asked, KeyframeImage) else asked.id,
        stamp_ns=asked.stamp_ns,
        epoch=asked.epoch,
        model="exact",
        bias_sigma=0.0,
        inference_ms=1.0,
        valid=True,
        reason="",
        image_to_depth=image_to_depth,
        depth=depth,
    )
    return replace(made, **changes)


def scale_of(keyframe: Keyframe, log_scale: float = 0.0, sigma: float = 0.05, **changes: object) -> Scale:
    """The scale estimate after a keyframe, which observed just that."""
    made = Scale(
        keyframe=keyframe.id,
        stamp_ns=keyframe.stamp_ns,
        epoch=keyframe.epoch,
        log_scale=log_scale,
        map_log_scale=log_scale,
        sigma=sigma,
        filter_sigma=sigma,
        observation=log_scale,
        observation_sigma=0.1,
        points=50,
        accepted=True,
        part=keyframe.part,
    )
    return replace(made, **changes)


def map_update(based_on: int, sequence: int = 1, **changes: object) -> MapUpdate:
    """A correction with what is given, and nothing else."""
    made = blank(MapUpdate, epoch=0, sequence=sequence, based_on=based_on, solve_ms=1.0)
    return replace(made, **changes)
