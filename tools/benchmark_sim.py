"""Speed of the simulator on one core, and how its pictures behave as ORB sees them.

    python tools/benchmark_sim.py [URI ...] [--frames N] [--video FOLDER]

For each simulated sequence: frames a second at its size (one thread), and over pairs of successive frames
the number of ORB features a picture offers, the share that is found again where the exact motion and depth
put it, and the share whose nearest descriptor is there. ``--video`` adds a folder of real pictures; since
real video has no exact truth, both get the share of features that agree on one fundamental matrix.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from prism_edge.cli.settings import whole_above_zero
from prism_edge.errors import PrismError, SourceError
from prism_edge.geometry.poses import inverse, transform
from prism_edge.sources.sim import SimSource

DEFAULT = (
    "sim:room?seed=1",
    "sim:room?seed=2&actors=2",
    "sim:loop?seed=1",
    "sim:loop?seed=1&path=wheeled",
    "sim:street?seed=1&rate=10",
)
FEATURES = 1000
NEAR_PIXELS = 2.0


def speed(source: SimSource, frames: int) -> tuple[float, float, float]:
    """Frames a second by the wall clock, and by CPU time; and the slowest frame (ms of CPU)."""
    source.image(0)
    spent = []
    began = time.perf_counter()
    for index in range(frames):
        before = time.process_time()
        source.image(index)
        spent.append(time.process_time() - before)
    wall = time.perf_counter() - began
    return frames / wall, frames / sum(spent), 1e3 * max(spent)


def features(grey: Any, most: int = FEATURES) -> tuple[Any, Any, Any]:
    """Pixels (n, 2), octaves (n,) and descriptors of a grey picture."""
    keypoints, descriptors = cv2.ORB.create(most, 1.2, 8, fastThreshold=20).detectAndCompute(grey, None)
    pixels = np.array([k.pt for k in keypoints]).reshape(-1, 2)
    return pixels, np.array([k.octave for k in keypoints]), descriptors


def agreeing(first: Any, second: Any) -> float:
    """Share of the first picture's features whose ratio-test matches fit one fundamental matrix."""
    if first[2] is None or second[2] is None:
        return 0.0
    pairs = cv2.BFMatcher(cv2.NORM_HAMMING).knnMatch(first[2], second[2], k=2)
    good = [p[0] for p in pairs if len(p) == 2 and p[0].distance < 0.8 * p[1].distance]
    if len(good) < 8:
        return 0.0
    here, there = first[0][[m.queryIdx for m in good]], second[0][[m.trainIdx for m in good]]
    _, inliers = cv2.findFundamentalMat(here, there, cv2.FM_RANSAC, 1.5)
    return 0.0 if inliers is None else float(inliers.sum()) / len(first[0])


def under_truth(source: SimSource, index: int, first: Any, second: Any) -> tuple[float, float, float]:
    """Of features that stay in view: share found again, share matched rightly; and median error (pixels)."""
    camera, depth = source.camera, source.depth(index)
    rows = np.rint(first[0]).astype(int)
    z = depth[rows[:, 1], rows[:, 0]]
    rays = np.concatenate([camera.normalise(first[0]), np.ones((len(z), 1))], axis=1)
    moved = transform(inverse(source.pose(index + 1)) @ source.pose(index), rays * z[:, None])
    expected = camera.project(moved)
    inside = np.all((expected > 20) & (expected < (camera.width - 20, camera.height - 20)), axis=1)
    expected, octaves, descriptors = expected[inside], first[1][inside], first[2][inside]
    distance = np.linalg.norm(expected[:, None] - second[0][None], axis=2)
    alike = np.abs(octaves[:, None] - second[1][None]) <= 1
    nearest = np.where(alike, distance, np.inf).min(axis=1)
    reach = NEAR_PIXELS * 1.2**octaves
    matches = cv2.BFMatcher(cv2.NORM_HAMMING).match(descriptors, second[2])
    right = np.array([distance[m.queryIdx, m.trainIdx] < reach[m.queryIdx] for m in matches])
    return float(np.mean(nearest < reach)), float(right.mean()), float(np.median(nearest[nearest < reach]))


def summary(name: str, rows: Sequence[tuple[float, ...]]) -> None:
    """One line of medians (and the tenth percentile of the number of features)."""
    table = np.array(rows)
    middle = np.median(table, axis=0)
    few = np.percentile(table[:, 0], 10)
    text = f"{name}: {middle[0]:.0f} ORB features (a tenth of frames below {few:.0f}), {middle[1]:.2f} agree"
    if table.shape[1] > 2:
        text += f"; true motion: {middle[2]:.2f} found again, {middle[3]:.2f} matched, {middle[4]:.2f} px off"
    print(text)


def simulated(uri: str, frames: int, pairs: int) -> None:
    """Measures one address."""
    source = SimSource(uri)
    before = time.process_time()
    if source.frame_count < 2:
        raise SourceError(f"{uri} has one frame; pairs of frames are compared")
    with source:
        opened = time.process_time() - before
        wall, cpu, slowest = speed(source, min(frames, source.frame_count))
        size = f"{source.camera.width}x{source.camera.height}"
        print(
            f"{uri}: {wall:.0f} frames/s ({cpu:.0f} by CPU time, slowest {slowest:.0f} ms) at {size}, "
            f"opened in {opened:.1f} s"
        )
        rows = []
        for index in np.linspace(0, source.frame_count - 2, pairs).astype(int).tolist():
            greys = [cv2.cvtColor(source.image(index + k).pixels, cv2.COLOR_BGR2GRAY) for k in (0, 1)]
            first, second = features(greys[0]), features(greys[1])
            count = len(features(greys[0], 20_000)[0])
            rows.append((count, agreeing(first, second), *under_truth(source, index, first, second)))
        summary("  " + uri, rows)


def pictures(folder: Path) -> list[Path]:
    """The pictures in a folder, in order; ends the program where there are not two."""
    there = folder.iterdir() if folder.is_dir() else ()
    files = sorted(p for p in there if p.suffix in (".jpg", ".png") and "depth" not in p.name)
    if len(files) < 2:
        raise SystemExit(f"{folder} holds no pictures")
    return files


def recorded(folder: Path, files: list[Path], pairs: int) -> None:
    """The same for real pictures, leaving out exact copies."""
    rows = []
    for index in np.linspace(0, len(files) - 2, pairs).astype(int).tolist():
        greys = [cv2.imread(str(files[index + k]), cv2.IMREAD_GRAYSCALE) for k in (0, 1)]
        first, second = greys
        if first is None or second is None or np.array_equal(first, second):
            continue
        count = len(features(first, 20_000)[0])
        rows.append((count, agreeing(features(first), features(second))))
    if not rows:
        raise SystemExit(f"{folder} holds no two pictures that differ")
    summary(str(folder), rows)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description="Speed of the simulator and ORB's view of it.")
    parser.add_argument("uri", nargs="*", default=DEFAULT, help="sim: addresses")
    parser.add_argument("--frames", type=whole_above_zero, default=200, help="frames timed")
    parser.add_argument("--pairs", type=whole_above_zero, default=30, help="pairs of frames that ORB sees")
    parser.add_argument("--video", type=Path, help="folder of real pictures to compare with")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    files = pictures(arguments.video) if arguments.video else []
    try:
        for uri in arguments.uri:
            simulated(uri, arguments.frames, arguments.pairs)
    except PrismError as error:
        sys.exit(str(error))
    if arguments.video:
        recorded(arguments.video, files, arguments.pairs)


if __name__ == "__main__":
    main()
