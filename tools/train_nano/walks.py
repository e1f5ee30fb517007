"""Renders what a camera sees on simulated walks, as ``tools.train_nano.render`` does for strewn views.

    python -m tools.train_nano.walks FOLDER [--rooms N] [--loops N] [--first SEED]

The pictures are those of the ``sim:`` source itself, with its noise, blur, exposure and people, at a size
of 640 x 480 shrunk to the half: what the network meets when it runs. Frames come in pairs that look at one
place, mostly from two visits to it. Seeds begin at 1 500 000, apart from all others.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.progress import track

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from prism_edge.cli.settings import whole_above_zero
from prism_edge.sources.sim import SimSource
from tools.train_nano.render import HEIGHT, LOOP_VIEWS, ROOM_VIEWS, WIDTH, Files, kinds_of

F64 = NDArray[np.float64]

FIRST_SEED = 1_500_000
ROOM_FRAMES = 6000  # 200 s of one room
_STEP = 10  # frames between those that are chosen among
_NEAR_M, _NEAR_DEG = 1.2, 40.0  # between the frames of a pair
_APART = 3  # steps between them, at least


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--rooms", type=_some, default=80, help="walks in one room (default 80)")
    parser.add_argument("--loops", type=_some, default=32, help="walks through eight rooms (default 32)")
    parser.add_argument("--first", type=int, default=FIRST_SEED, help="seed of the first walk")
    arguments = parser.parse_args()
    if not arguments.rooms + arguments.loops:
        parser.error("no walk is asked for: --rooms or --loops must be above 0")
    cv2.setNumThreads(1)
    render(arguments.folder, arguments.rooms, arguments.loops, arguments.first)


def _some(text: str) -> int:
    return 0 if text == "0" else whole_above_zero(text)


def render(folder: Path, rooms: int, loops: int, first: int) -> None:
    """Writes the three files; the same arguments give the same bytes."""
    kinds = kinds_of(rooms, loops)
    files = Files(folder, first, np.where(kinds, LOOP_VIEWS, ROOM_VIEWS))
    np.seterr(over="ignore", invalid="ignore")  # nothing is drawn at 1e6 m, which becomes infinity
    for number in track(range(len(kinds)), description="rendering walks"):
        rows = files.rows(number)
        images, depths = files.images[rows], files.depths[rows]
        poses, focal = render_walk(bool(kinds[number]), first + number, images, depths)
        files.add(number, poses, np.full(len(poses), focal))
    files.close()


def render_walk(
    loop: bool, seed: int, images: NDArray[np.uint8], depths: NDArray[np.float16]
) -> tuple[F64, float]:
    """Fills one walk's pictures and depths; poses (n, 4, 4) and the focal length in the pictures' pixels."""
    rng = np.random.default_rng([seed, 101])
    path = "wheeled" if rng.random() < 0.25 else "handheld"
    effects = "&".join(f"{name}={rng.uniform(0.3, 1.7):.2f}" for name in ("noise", "blur", "exposure"))
    address = f"path={path}&actors={rng.integers(0, 4)}&focal={rng.uniform(440, 560):.1f}&{effects}"
    kind = f"loop?seed={seed}" if loop else f"room?seed={seed}&frames={ROOM_FRAMES}"
    with SimSource(f"sim:{kind}&{address}") as source:
        frames = np.arange(0, source.frame_count, _STEP)
        among = np.array([source.pose(int(frame)) for frame in frames])
        poses = []
        for row, chosen in enumerate(pairs(among, len(images) // 2, rng)):
            frame = int(frames[chosen])
            picture = cv2.cvtColor(source.image(frame).pixels, cv2.COLOR_BGR2RGB)
            images[row] = cv2.resize(picture, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)
            depths[row] = source.depth(frame)[2::4, 2::4]
            poses.append(among[chosen])
        return np.array(poses), source.camera.fx * WIDTH / source.camera.width


def pairs(poses: F64, count: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Rows (2 count,) of ``poses`` (n, 4, 4): those 2k and 2k + 1 are near each other and look one way.

    Where there is nothing of the kind apart in time, the next but few is taken.
    """
    position = poses[:, :3, 3]
    far = np.linalg.norm(position[:, None] - position[None], axis=2)
    cosine = (np.einsum("iab,jab->ij", poses[:, :3, :3], poses[:, :3, :3]) - 1) / 2
    near = (far < _NEAR_M) & (cosine > np.cos(np.radians(_NEAR_DEG)))
    order = np.arange(len(poses))
    near &= np.abs(order[:, None] - order[None]) >= _APART
    chosen = []
    for one in rng.choice(len(poses), count, replace=len(poses) < count):
        others = np.flatnonzero(near[one])
        away = others[np.abs(others - one) >= 30]  # another visit, where there is one
        if len(away) and rng.random() < 0.7:
            others = away
        if not len(others):
            others = np.array([one + _APART if one + _APART < len(poses) else one - _APART])
        chosen += [int(one), int(rng.choice(others))]
    return np.array(chosen)


if __name__ == "__main__":
    main()
