"""A network on simulated walks that nobody trained on, as the daemon runs it: depth, scale, revisited places.

    python -m tools.train_nano.measure [--model MODEL] [--every N] [SIM ...]

For each walk: AbsRel, delta < 1.25 and the median ratio true / predicted frame by frame (its mean, and its
spread), how well the network knows its own error, and for walks that come back, how often the likeliest
earlier frame by its descriptor shows the same place. That is told by two rules. By sight, as of strewn views:
asked is about frames that share 35 % of the picture with an earlier one, and found is one that shares 18 %.
By pose: within a metre and 40 degrees, for asking and for finding. The second takes a frame from 1.3 m away
that shows four fifths of the same for another place, so beside it stands what one would reach who always
found the earlier frame with the largest overlap.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from prism_edge.cli.settings import whole_above_zero
from prism_edge.config import DepthConfig
from prism_edge.depth import DepthNetwork, open_network
from prism_edge.errors import PrismError
from prism_edge.sources.sim import SimSource
from tools.train_nano.render import overlaps
from tools.train_nano.ruler import FOUND, SEEN_TOGETHER

F64 = NDArray[np.float64]

WALKS = tuple(f"sim:room?seed={seed}" for seed in range(11, 17)) + tuple(
    f"sim:loop?seed={seed}" for seed in range(11, 15)
)
NEAR_M, NEAR_DEG = 1.0, 40.0
APART_S = 10.0  # between two visits
FARTHEST = 20.0  # m
COARSE = (160, 120)  # of the depth that overlap is told from


class Walk(NamedTuple):
    """Figures of frames (n,) of one walk."""

    stamps_s: F64
    poses: F64  # (n, 4, 4)
    absrel: F64
    within_125: F64
    log_ratio: F64
    real_error: F64  # mean absolute log error
    own_error: F64  # mean expected one, nan without confidence
    descriptors: F64  # (n, d)
    overlap: F64  # (n, n), the mean of both directions


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("walks", metavar="SIM", nargs="*", default=WALKS)
    parser.add_argument("--model", default="prism_nano")
    parser.add_argument(
        "--every", type=whole_above_zero, default=10, metavar="N", help="take each N-th frame"
    )
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    try:
        network = open_network(arguments.model, DepthConfig())
        walks = []
        for uri in arguments.walks:
            walks.append(walk_through(uri, network, arguments.every))
            print(f"{uri}: {words(walks[-1])}", flush=True)
    except PrismError as error:
        print(f"measure: error: {error}", file=sys.stderr)
        return error.exit_code
    means = [walk.log_ratio.mean() for walk in walks]
    print(
        f"all walks: AbsRel {np.mean([walk.absrel.mean() for walk in walks]):.3f}, spread of the walks' "
        f"log scale {np.std(means):.3f} about {np.mean(means):+.3f}" + recalls(walks)
    )
    return 0


def walk_through(uri: str, network: DepthNetwork, every: int) -> Walk:
    """Each ``every``-th frame of a simulated walk through a network."""
    rows, depths = [], []
    with SimSource(uri) as source:
        for index in range(0, source.frame_count, every):
            picture = cv2.cvtColor(source.image(index).pixels, cv2.COLOR_BGR2RGB)
            predicted = network.infer(picture, source.camera)
            a, b, c, d = predicted.image_to_depth
            y, x = np.mgrid[0 : predicted.depth.shape[0], 0 : predicted.depth.shape[1]]
            x, y = ((x - b) / a).astype(np.float32), ((y - d) / c).astype(np.float32)
            exact = source.depth(index)
            truth = cv2.remap(exact, x, y, cv2.INTER_NEAREST)
            depths.append(cv2.resize(exact, COARSE, interpolation=cv2.INTER_NEAREST))
            both = (truth > 0) & (truth < FARTHEST) & (predicted.depth > 0)
            ratio = np.log(truth[both]) - np.log(predicted.depth[both])
            own = 1.0 / predicted.confidence[both] if predicted.confidence.size else np.array([np.nan])
            rows.append(
                (
                    source.stamp_ns(index) * 1e-9,
                    source.pose(index),
                    np.mean(np.abs(np.expm1(-ratio))),
                    np.mean(np.abs(ratio) < np.log(1.25)),
                    np.median(ratio),
                    np.mean(np.abs(ratio)),
                    np.mean(own),
                    predicted.descriptor,
                )
            )
        focal = source.camera.fx * 2 * COARSE[0] / source.camera.width  # overlaps() has it of twice the size
    columns = [np.array(column, dtype=np.float64) for column in zip(*rows, strict=True)]
    shared = overlaps(np.array(depths, dtype=np.float16), columns[1], np.full(len(rows), focal))
    return Walk(*columns, overlap=(shared + shared.T) / 2)


class Revisits(NamedTuple):
    """For frames of one walk that ask for an earlier one, whether what was found is the same place."""

    seen: NDArray[np.bool_]  # by what is seen
    taken: NDArray[np.bool_]  # by where it was taken
    limit: NDArray[np.bool_]  # the same, of the earlier frame with the largest overlap


def revisits(walk: Walk) -> Revisits:
    """Judges the likeliest earlier frame of each; empty for a network without descriptors."""
    gap = walk.stamps_s[:, None] - walk.stamps_s[None] >= APART_S  # [now, earlier]
    position = walk.poses[:, :3, 3]
    far = np.linalg.norm(position[:, None] - position[None], axis=2)
    cosine = (np.einsum("iab,jab->ij", walk.poses[:, :3, :3], walk.poses[:, :3, :3]) - 1) / 2
    near = (far < NEAR_M) & (np.degrees(np.arccos(np.clip(cosine, -1, 1))) < NEAR_DEG)
    if not walk.descriptors.size:
        return Revisits(*(np.zeros(0, bool) for _ in Revisits._fields))
    row = np.arange(len(near))
    found = np.where(gap, walk.descriptors @ walk.descriptors.T, -np.inf).argmax(axis=1)
    fullest = np.where(gap, walk.overlap, -np.inf).argmax(axis=1)
    asks = (gap & (walk.overlap >= SEEN_TOGETHER)).any(axis=1)
    again = (gap & near).any(axis=1)
    return Revisits(
        seen=walk.overlap[row, found][asks] >= FOUND,
        taken=near[row, found][again],
        limit=near[row, fullest][again],
    )


def recalls(walks: Sequence[Walk]) -> str:
    """Recall@1 of all frames of some walks; nothing where none asks."""
    parts = zip(*(revisits(walk) for walk in walks), strict=True)
    seen, taken, limit = (np.concatenate(part) for part in parts)
    said = f", recall@1 by sight {seen.mean():.3f} of {len(seen)}" if len(seen) else ""
    if len(taken):
        said += f", by pose {taken.mean():.3f} of {len(taken)} (largest overlap: {limit.mean():.3f})"
    return said


def words(walk: Walk) -> str:
    """One line."""
    return (
        f"AbsRel {walk.absrel.mean():.3f}, within 1.25 {walk.within_125.mean():.3f}, ratio "
        f"{np.exp(walk.log_ratio.mean()):.3f}, log spread {walk.log_ratio.std():.3f}, error "
        f"{walk.real_error.mean():.3f} (expected {walk.own_error.mean():.3f})"
        + recalls([walk])
    )


if __name__ == "__main__":
    sys.exit(main())
