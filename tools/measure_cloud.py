"""Measures a cloud of `prism-edge reconstruct` against what the recording's depth camera saw.

    python tools/measure_cloud.py FOLDER CLOUD.ply --map MAP [--truth FILE.tum] [--up-to-scale]

FOLDER is a TUM RGB-D (or BONN) or 7-Scenes folder with true poses (or those of --truth, of the colour
camera). Its depth images, laid together from there, are the reference. The cloud is brought over by the map's
keyframes (rigidly; with --up-to-scale by a similarity, where a network's metres are known to be wrong), then
by ICP, 20 cm and 5 cm, as the paper's appendix does. Printed are Chamfer distance, precision, recall and
F-score at two distances, thickness of surfaces, points. Neither poses nor depth of FOLDER reach the cloud.
Needs scipy (the extra dev).
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

try:
    from scipy.spatial import cKDTree
except ImportError:
    sys.exit("measure_cloud: error: needs scipy; the extra dev has it")

from prism_edge.cli.map_opened import opened
from prism_edge.config import SourceConfig
from prism_edge.config_file import load
from prism_edge.errors import EvaluationError, PrismError
from prism_edge.evaluation.trajectory import Trajectory, read_tum
from prism_edge.geometry.alignment import align
from prism_edge.geometry.poses import from_rt, so3_exp, transform
from prism_edge.reconstruction.cloud import Cloud, Voxels, lay
from prism_edge.scale.gate import DepthView
from prism_edge.sources import open_source
from prism_edge.sources.sensor_depth import COLOUR_IN_DEPTH, SensorDepth, image_to_depth
from prism_edge.sources.truth import read_truth
from tools.true_poses import pose_of_image

F64 = NDArray[np.float64]

ICP = ((0.2, 15), (0.05, 15))  # m that counterparts are apart at most, and rounds
SAMPLED, NEIGHBOURS = 20_000, 30
NO_CONFIDENCE = np.zeros((0, 0), np.float32)


@dataclass(frozen=True)
class Scores:
    """Distances (m) from the cloud to the reference and back, and the mean thickness (m) of its surfaces."""

    to_reference: F64
    to_cloud: F64
    thickness: float

    @property
    def chamfer(self) -> float:
        """The mean of both mean distances, m."""
        return 0.5 * float(self.to_reference.mean() + self.to_cloud.mean())

    def f_score(self, within: float) -> tuple[float, float, float]:
        """Precision, recall and their harmonic mean at a distance, m."""
        precision, recall = float((self.to_reference < within).mean()), float((self.to_cloud < within).mean())
        return precision, recall, 2 * precision * recall / max(precision + recall, 1e-12)


def main(arguments: list[str] | None = None) -> int:
    form = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=form)
    parser.add_argument("folder", metavar="FOLDER", type=Path)
    parser.add_argument("cloud", metavar="CLOUD.ply", type=Path)
    parser.add_argument("--map", required=True, help="the map that the cloud was made of")
    parser.add_argument("--truth", metavar="FILE.tum", type=Path, help="poses in place of the folder's own")
    parser.add_argument("--camera", metavar="FILE", default="", help="camera file, as the map was made with")
    parser.add_argument("--up-to-scale", action="store_true", help="let the alignment choose the scale")
    parser.add_argument("--voxel", type=float, default=0.02, help="of the reference, m (default 0.02)")
    parser.add_argument("--within", type=float, nargs=2, default=(0.02, 0.05), help="m (default 0.02 0.05)")
    parser.add_argument("--far", type=float, default=8.0, help="m, of the reference (default 8)")
    args = parser.parse_args(arguments)
    cv2.setNumThreads(1)
    try:
        truth = poses_of(args.folder, args.truth, args.camera)
        points = read_ply(args.cloud)
        found = opened(args.map, load(None, {})).metric
        guess, scale = first_guess(found.trajectory(False), truth, args.up_to_scale)
        seen = reference(args.folder, truth, args.voxel, args.far, args.camera)
        scores = score(scale * points, seen, guess)
    except (PrismError, OSError, ValueError) as error:
        print(f"measure_cloud: error: {error}", file=sys.stderr)
        return getattr(error, "exit_code", 1)
    print(f"{args.cloud.name}: {len(points)} points, reference {len(seen.points)}, scale {scale:.3f}")
    print(
        f"  Chamfer {100 * scores.chamfer:.1f} cm (to the reference {100 * scores.to_reference.mean():.1f}, "
        f"median {100 * np.median(scores.to_reference):.1f}; back {100 * scores.to_cloud.mean():.1f})"
    )
    for within in args.within:
        precision, recall, f = scores.f_score(within)
        print(f"  F at {100 * within:g} cm: {f:.1%} (precision {precision:.1%}, recall {recall:.1%})")
    print(f"  thickness {100 * scores.thickness:.1f} cm")
    return 0


def poses_of(folder: Path, file: Path | None, camera: str = "") -> Trajectory:
    """True poses of the colour camera. Raises EvaluationError where there are none."""
    if file is not None:
        return read_tum(file)
    own = read_truth(str(folder))
    if own is None:
        raise EvaluationError(f"{folder} has no true poses: give --truth FILE.tum")
    stamps, poses = own
    with open_source(SourceConfig(uri=str(folder), camera=camera)) as source:
        own_camera = source.camera
    if SensorDepth(folder).is_apart(own_camera):  # 7-Scenes' poses are the depth camera's
        poses = poses @ from_rt(np.eye(3), COLOUR_IN_DEPTH)
    return Trajectory(stamps, poses)


def read_ply(path: Path) -> F64:
    """Points (n, 3) of a file that `prism-edge reconstruct` or `map export` wrote. Raises ValueError."""
    header, end, body = path.read_bytes().partition(b"end_header\n")
    words = [line.split() for line in header.decode("ascii", "replace").splitlines()]
    dtypes = {"float": "<f4", "uchar": "u1"}
    columns = [(w[2], dtypes[w[1]]) for w in words if w[:1] == ["property"] and w[1] in dtypes]
    if not end or [name for name, _ in columns[:3]] != ["x", "y", "z"]:
        raise ValueError(f"{path}: no PLY file of points")
    rows = np.frombuffer(body, np.dtype(columns))
    return np.stack([rows[axis] for axis in "xyz"], axis=1).astype(np.float64)


def first_guess(
    keyframes: list[tuple[int, F64]], truth: Trajectory, with_scale: bool
) -> tuple[F64, float]:
    """truth_from_map (4, 4) and its scale by where the keyframes are. Raises EvaluationError."""
    both = [(pose, pose_of_image(truth, stamp)) for stamp, pose in keyframes]
    pairs = [(pose[:3, 3], at[:3, 3]) for pose, at in both if at is not None]
    if len(pairs) < 3:
        raise EvaluationError(f"{len(pairs)} keyframes have a true pose: is the map of this recording?")
    mine, true = (np.array(side) for side in zip(*pairs, strict=True))
    found = align(mine, true, with_scale)
    return from_rt(found.rotation, found.translation), found.scale


def reference(folder: Path, truth: Trajectory, voxel: float, farthest: float, camera: str = "") -> Cloud:
    """What the depth camera saw, from the true poses."""
    sensor, voxels = SensorDepth(folder), Voxels(voxel)
    with open_source(SourceConfig(uri=str(folder), camera=camera)) as source:
        while (slot := source.peek()) is not None:
            source.skip()
            pose = pose_of_image(truth, slot.stamp_ns)
            depth = None if pose is None else sensor.in_colour(slot.index, source.camera)
            if pose is None or depth is None:
                continue
            placed = image_to_depth(depth, source.camera)
            near = np.where(depth < farthest, depth, np.float32(0))
            view = DepthView(slot.index, pose, source.camera, near, placed, NO_CONFIDENCE, 1.0)
            lay(voxels, view, near > 0, np.zeros((*depth.shape, 3), np.uint8))
    return voxels.cloud()


def score(points: F64, seen: Cloud, guess: F64) -> Scores:
    """Distances both ways after ICP from a first guess (4, 4). Raises EvaluationError for hardly any."""
    if min(len(points), len(seen.points)) < NEIGHBOURS:
        counts = f"{len(points)} points, and the depth camera's {len(seen.points)}"
        raise EvaluationError(f"the cloud has {counts}: {NEIGHBOURS} are needed")
    rng, tree = np.random.default_rng(0), cKDTree(seen.points)
    placed = transform(icp(points[rng.permutation(len(points))[:SAMPLED]], seen, tree, guess), points)
    mine = cKDTree(placed)
    chosen = placed[rng.permutation(len(placed))[:SAMPLED]]
    around = placed[mine.query(chosen, k=NEIGHBOURS)[1]]
    around = around - around.mean(axis=1, keepdims=True)
    least = np.linalg.eigvalsh(np.einsum("nki,nkj->nij", around, around) / around.shape[1])[:, 0]
    thickness = float(np.sqrt(np.maximum(least, 0.0)).mean())
    return Scores(tree.query(placed)[0], mine.query(seen.points)[0], thickness)


def icp(points: F64, seen: Cloud, tree: cKDTree, guess: F64) -> F64:
    """The pose (4, 4) that lays points (n, 3) on the reference's planes, from a guess."""
    pose = guess
    for within, rounds in ICP:
        for _ in range(rounds):
            moved = transform(pose, points)
            distances, rows = tree.query(moved, distance_upper_bound=within)
            near = np.isfinite(distances)
            if near.sum() < 100:
                break
            at, normals = moved[near], seen.normals[rows[near]]
            off = np.sum((seen.points[rows[near]] - at) * normals, axis=1)
            design = np.hstack([normals, np.cross(at, normals)])
            step = np.linalg.lstsq(design, off, rcond=None)[0]
            pose = from_rt(so3_exp(step[3:]), step[:3]) @ pose
    return pose


if __name__ == "__main__":
    sys.exit(main())
