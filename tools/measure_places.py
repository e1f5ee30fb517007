"""Measures how well a network's place descriptor finds revisited places on a recording with true poses.

    python tools/measure_places.py FOLDER --model MODEL [--every N]

Two frames more than 100 apart see the *same place* when their cameras are within 0.3 m and 20 degrees of
each other, *another* beyond 0.6 m or 40 degrees; what lies between is neither. Printed are the chance that
a pair of the first kind is more alike than one of the second (AUC), what the most alike distant frame of
each revisit is, the share of revisits found before the first false match, and the mean cosines.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from prism_edge.cli.settings import whole_above_zero
from prism_edge.config import DepthConfig, SourceConfig
from prism_edge.depth import open_onnx
from prism_edge.depth.prediction import normalised
from prism_edge.depth.session import OnnxNetwork
from prism_edge.errors import PrismError
from prism_edge.sources.base import Image
from prism_edge.sources.open import open_source
from tools.true_poses import own_truth, pose_of_image

F64 = NDArray[np.float64]

APART = 100  # frames: less is not coming back, but not having left
SAME_M, SAME_DEG = 0.3, 20.0
OTHER_M, OTHER_DEG = 0.6, 40.0


@dataclass(frozen=True)
class PlaceScore:
    """How alike frames of one place are, against frames of different places."""

    revisits: int  # frames that have a distant frame of the same place
    auc: float
    same: float  # share of revisits whose most alike distant frame is of the same place
    other: float  # ... of another
    before_false: float  # share of revisits matched rightly at a threshold that admits no false match
    cosine_same: float  # mean over pairs
    cosine_other: float


def main(arguments: list[str] | None = None) -> int:
    form = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=form)
    parser.add_argument("folder", metavar="FOLDER", help="recording with true poses")
    parser.add_argument("--model", required=True, help="ONNX file or known name")
    parser.add_argument("--every", type=whole_above_zero, default=5, metavar="N", help="each N-th frame (5)")
    args = parser.parse_args(arguments)
    cv2.setNumThreads(1)
    try:
        network = open_onnx(args.model, DepthConfig(threads=1))
        indices, poses, descriptors, silent = describe(args.folder, network, args.every)
    except PrismError as error:
        print(f"measure_places: error: {error}", file=sys.stderr)
        return error.exit_code
    score = score_places(indices, poses, descriptors) if descriptors.size else None
    if score is None:
        print("measure_places: error: no descriptor, no true pose, or no place seen twice", file=sys.stderr)
        return 1
    card = network.card
    what = f"{card.descriptor_pooling} of {card.descriptor_layer}" if card.descriptor_layer else "its own"
    print(f"{network.name} on {args.folder}: {what}, {descriptors.shape[1]} numbers, {len(indices)} frames")
    if silent:
        print(f"  left out: {silent} frames of which the descriptor says nothing (all 0, or not finite)")
    print(f"  AUC: {score.auc:.3f}")
    print(f"  revisits: {score.revisits}; best match {score.same:.2f} same place, {score.other:.2f} another")
    print(f"  found before the first false match: {score.before_false:.2f}")
    print(f"  mean cosine: same place {score.cosine_same:.3f}, another {score.cosine_other:.3f}")
    return 0


def describe(folder: str, network: OnnxNetwork, every: int) -> tuple[NDArray[np.int64], F64, F64, int]:
    """Frame indices (n,), their true poses (n, 4, 4) and descriptors (n, m) of each ``every``-th frame.

    Last comes how many more there are whose descriptor says nothing: the daemon compares none such either.
    """
    truth = own_truth(folder)
    indices, poses, descriptors, silent = [], [], [], 0
    with open_source(SourceConfig(uri=folder)) as source:
        while (slot := source.peek()) is not None:
            if slot.index % every:
                source.skip()
                continue
            image = source.read()
            pose = pose_of_image(truth, image.stamp_ns) if isinstance(image, Image) else None
            if pose is None or not isinstance(image, Image):
                continue
            pixels = image.pixels
            rgb = pixels[:, :, ::-1] if pixels.ndim == 3 else np.repeat(pixels[:, :, None], 3, axis=2)
            descriptor = normalised(network.raw(np.ascontiguousarray(rgb))[0].descriptor)
            if not descriptor.size:
                silent += 1
                continue
            indices.append(slot.index)
            poses.append(pose)
            descriptors.append(descriptor)
    return np.array(indices, np.int64), np.array(poses), np.array(descriptors, np.float64), silent


def score_places(indices: NDArray[np.int64], poses: F64, descriptors: F64) -> PlaceScore | None:
    """Scores unit descriptors (n, m) of frames at world_from_camera (n, 4, 4); None without revisits."""
    cosine = descriptors @ descriptors.T
    distance = np.linalg.norm(poses[:, None, :3, 3] - poses[None, :, :3, 3], axis=2)
    traces = np.einsum("aij,bij->ab", poses[:, :3, :3], poses[:, :3, :3])
    angle = np.degrees(np.arccos(np.clip((traces - 1.0) / 2.0, -1.0, 1.0)))
    apart = np.abs(indices[:, None] - indices[None]) > APART
    same = apart & (distance < SAME_M) & (angle < SAME_DEG)
    other = apart & ((distance > OTHER_M) | (angle > OTHER_DEG))
    revisits = same.any(axis=1)
    if not revisits.any() or not other.any():
        return None
    best = np.where(apart, cosine, -np.inf).argmax(axis=1)
    rows = np.arange(len(indices))
    found, false = same[rows, best], other[rows, best] & apart.any(axis=1)
    highest = cosine[rows, best]
    threshold = highest[false].max() if false.any() else -np.inf
    ordered = np.sort(cosine[other])
    below, up_to = (np.searchsorted(ordered, cosine[same], side) for side in ("left", "right"))
    return PlaceScore(
        revisits=int(revisits.sum()),
        auc=float((below + up_to).mean() / (2 * len(ordered))),  # as alike as another: half
        same=float(found[revisits].mean()),
        other=float(false[revisits].mean()),
        before_false=float((found & (highest > threshold))[revisits].mean()),
        cosine_same=float(cosine[same].mean()),
        cosine_other=float(cosine[other].mean()),
    )


if __name__ == "__main__":
    sys.exit(main())
