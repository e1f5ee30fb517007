"""From looks to a cloud: depth held to the pictures, then to each other, then laid together."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from prism_edge.reconstruction.cloud import Cloud, Voxels, lay
from prism_edge.reconstruction.consensus import consensus
from prism_edge.reconstruction.look import Look, surface
from prism_edge.reconstruction.sweep import corrected, sweep, with_baseline
from prism_edge.scale.gate import GateParameters

TOLERANCE = 0.03  # of log depth, within which keyframes agree
MOST_BESIDE = 8  # keyframes that each is held to

Progress = Callable[[str, int, int], None]  # what is done, how many of how many


@dataclass(frozen=True)
class Options:
    """What a reconstruction may be asked for."""

    voxel: float = 0.02  # m, a point each
    agreeing: int = 3  # keyframes that must see a surface alike
    farthest: float = math.inf  # m from the camera
    by_pictures: bool = True  # whether depth is held to the pictures
    gate: GateParameters | None = None  # None: it stays open


@dataclass(frozen=True)
class Reconstruction:
    """The cloud, and what share of the pixels that had depth came into it."""

    cloud: Cloud
    kept: float
    beyond: int  # pixels that lie farther from map's origin than voxels of this size can be counted
    sure: float  # share of them whose depth the pictures say; nan where they were not asked


def reconstruct(
    looks: Mapping[int, Look],
    beside: Mapping[int, Sequence[int]],
    options: Options,
    progress: Progress = lambda what, done, of: None,
) -> Reconstruction:
    """One cloud of all ``looks``, by keyframe; ``beside`` names those that show some of the same, best first.

    All poses and depths are in metres of one frame, which is the cloud's.
    """
    near = {k: [j for j in beside.get(k, ()) if j in looks][: 2 * MOST_BESIDE] for k in looks}
    pixels = max(1, sum(int((look.view.depth > 0).sum()) for look in looks.values()))
    sure = math.nan
    if options.by_pictures:
        looks, sure = _held_to_pictures(looks, near, progress)
        sure /= pixels
    voxels, kept, beyond = Voxels(options.voxel), 0, 0
    for done, (keyframe, look) in enumerate(looks.items()):
        progress("agreeing", done, len(looks))
        others = [looks[j] for j in near[keyframe][:MOST_BESIDE]]
        found = consensus(look, others, TOLERANCE, options.gate)
        view, chosen = look.with_depth(found.depth).view, found.kept(options.agreeing)
        if math.isfinite(options.farthest):
            chosen &= np.linalg.norm(surface(view), axis=2) <= options.farthest
        laid, lost = lay(voxels, view, chosen, look.colours)
        kept, beyond = kept + laid, beyond + lost
    progress("agreeing", len(looks), len(looks))
    return Reconstruction(voxels.cloud(), kept / pixels, beyond, sure)


def _held_to_pictures(
    looks: Mapping[int, Look], near: Mapping[int, Sequence[int]], progress: Progress
) -> tuple[dict[int, Look], int]:
    """The looks at the depths that their pictures show, and at how many pixels those do."""
    moved, sure = dict(looks), 0
    for done, (keyframe, look) in enumerate(looks.items()):
        progress("comparing pictures", done, len(looks))
        others = with_baseline(look, [looks[j] for j in near[keyframe]])
        if others:
            found = sweep(look, others)
            moved[keyframe] = corrected(look, found)
            sure += int(np.sum(found.sure))
    return moved, sure
