"""A network on simulated walks that nobody trained on, as the daemon runs it: depth, scale, revisited places.

    python -m tools.train_nano.measure [--model MODEL] [--every N] [SIM ...]

For each walk: AbsRel, delta < 1.25 and the median ratio true / predicted frame by frame (its mean, and its
spread), how well the network knows its own error, and for walks that come back, how often the likeliest
earlier frame by its descriptor was taken at the same place: within a metre, and 40 degrees.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from prism_edge.config import DepthConfig
from prism_edge.depth import DepthNetwork, open_network
from prism_edge.errors import PrismError
from prism_edge.sources.sim import SimSource

F64 = NDArray[np.float64]

WALKS = tuple(f"sim:room?seed={seed}" for seed in range(11, 17)) + tuple(
    f"sim:loop?seed={seed}" for seed in range(11, 15)
)
NEAR_M, NEAR_DEG = 1.0, 40.0
APART_S = 10.0  # between two visits
FARTHEST = 20.0  # m


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


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("walks", metavar="SIM", nargs="*", default=WALKS)
    parser.add_argument("--model", default="prism_nano")
    parser.add_argument("--every", type=int, default=10, metavar="N", help="take each N-th frame")
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
    found = [value for walk in walks if len(value := revisits(walk))]
    print(
        f"all walks: AbsRel {np.mean([walk.absrel.mean() for walk in walks]):.3f}, spread of the walks' "
        f"log scale {np.std(means):.3f} about {np.mean(means):+.3f}"
        + (f", recall@1 {np.concatenate(found).mean():.3f}" if found else "")
    )
    return 0


def walk_through(uri: str, network: DepthNetwork, every: int) -> Walk:
    """Each ``every``-th frame of a simulated walk through a network."""
    rows = []
    with SimSource(uri) as source:
        for index in range(0, source.frame_count, every):
            picture = cv2.cvtColor(source.image(index).pixels, cv2.COLOR_BGR2RGB)
            predicted = network.infer(picture, source.camera)
            a, b, c, d = predicted.image_to_depth
            y, x = np.mgrid[0 : predicted.depth.shape[0], 0 : predicted.depth.shape[1]]
            x, y = ((x - b) / a).astype(np.float32), ((y - d) / c).astype(np.float32)
            truth = cv2.remap(source.depth(index), x, y, cv2.INTER_NEAREST)
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
    return Walk(*(np.array(column, dtype=np.float64) for column in zip(*rows, strict=True)))


def revisits(walk: Walk) -> NDArray[np.bool_]:
    """For each frame at a place seen before, whether its likeliest earlier frame is there."""
    gap = walk.stamps_s[:, None] - walk.stamps_s[None] >= APART_S  # [now, earlier]
    position = walk.poses[:, :3, 3]
    far = np.linalg.norm(position[:, None] - position[None], axis=2)
    cosine = (np.einsum("iab,jab->ij", walk.poses[:, :3, :3], walk.poses[:, :3, :3]) - 1) / 2
    same = (far < NEAR_M) & (np.degrees(np.arccos(np.clip(cosine, -1, 1))) < NEAR_DEG)
    again = (gap & same).any(axis=1)
    if not walk.descriptors.size:
        return np.zeros(0, bool)
    alike = np.where(gap, walk.descriptors @ walk.descriptors.T, -np.inf)
    return np.asarray(same[np.arange(len(same)), alike.argmax(axis=1)][again])


def words(walk: Walk) -> str:
    """One line."""
    found = revisits(walk)
    return (
        f"AbsRel {walk.absrel.mean():.3f}, within 1.25 {walk.within_125.mean():.3f}, ratio "
        f"{np.exp(walk.log_ratio.mean()):.3f}, log spread {walk.log_ratio.std():.3f}, error "
        f"{walk.real_error.mean():.3f} (expected {walk.own_error.mean():.3f})"
        + (f", recall@1 {found.mean():.3f} of {len(found)}" if len(found) else "")
    )


if __name__ == "__main__":
    sys.exit(main())
