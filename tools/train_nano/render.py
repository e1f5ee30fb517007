"""Renders the pictures that prism-nano learns from: simulated worlds, strewn views, exact depth and poses.

    python -m tools.train_nano.render FOLDER [--rooms N] [--loops N] [--worlds N] [--first SEED]

Worlds are those of ``sim:`` with seeds from 1 000 000 upwards, so no seed that a person types is among
them; most get new colours, surface by surface. Each world has views in pairs that look at one place, from
where a person, a robot or a hand could hold a camera. FOLDER receives images.npy (n, 240, 320, 3) uint8 RGB,
depth.npy (n, 120, 160) float16 metres, and views.npz: world (n,), focal (n,) pixels of the image, pose
(n, 4, 4) world_from_camera, and overlap (n, most views of a world), the share of a picture that another
view of its world sees too.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.progress import track

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from prism_edge.geometry.cameras import Camera
from prism_edge.sources.sim.actors import Walker, walkers_at
from prism_edge.sources.sim.floorplan import Plan, make_plan
from prism_edge.sources.sim.paths import looking
from prism_edge.sources.sim.renderer import Renderer
from prism_edge.sources.sim.world import World, build_world

F64 = NDArray[np.float64]

WIDTH, HEIGHT = 320, 240
FIRST_SEED, HELD_OUT_SEED = 1_000_000, 2_000_000  # of the worlds trained on, and of those judged on
ROOM_VIEWS, LOOP_VIEWS = 40, 160  # even: views come in pairs
_CAMERAS = 3  # of different focal lengths in each world
_NEAREST = 0.15  # m; a view with much nearer things shows nothing to learn from
_GRID = 12  # rows of points that overlap is counted on


class View(NamedTuple):
    """Where one picture is taken."""

    pose: F64  # (4, 4) world_from_camera
    focal: float  # pixels


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--rooms", type=int, default=240, help="worlds of one room (default 240)")
    parser.add_argument("--loops", type=int, default=40, help="worlds of eight rooms (default 40)")
    parser.add_argument("--worlds", type=int, default=0, help="stop after so many worlds (default: all)")
    parser.add_argument("--first", type=int, default=FIRST_SEED, help="seed of the first world")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    render(arguments.folder, arguments.rooms, arguments.loops, arguments.worlds, arguments.first)


def render(folder: Path, rooms: int, loops: int, worlds: int, first: int) -> None:
    """Writes the three files; the same arguments give the same bytes."""
    kinds = kinds_of(rooms, loops)[: worlds or None]
    files = Files(folder, first, np.where(kinds, LOOP_VIEWS, ROOM_VIEWS))
    np.seterr(over="ignore", invalid="ignore")  # nothing is drawn at 1e6 m, which becomes infinity
    for number in track(range(len(kinds)), description="rendering worlds"):
        rows = files.rows(number)
        views = render_world(bool(kinds[number]), first + number, files.images[rows], files.depths[rows])
        files.add(number, np.array([view.pose for view in views]), np.array([view.focal for view in views]))
    files.close()


def kinds_of(rooms: int, loops: int) -> NDArray[np.bool_]:
    """Which worlds are loops, spread evenly: any stretch of the files is a fair sample of both kinds."""
    kinds = np.zeros(rooms + loops, dtype=bool)
    if loops:
        kinds[np.linspace(0, rooms + loops - 1, loops).astype(int)] = True
    return kinds


class Files:
    """The three files while they are written: ``counts`` views of each world, seeds from ``first`` up."""

    def __init__(self, folder: Path, first: int, counts: NDArray[np.int64]) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._folder, self._first, self._counts = folder, first, counts
        total = int(counts.sum())
        self.images = np.lib.format.open_memmap(
            folder / "images.npy", "w+", np.uint8, (total, HEIGHT, WIDTH, 3)
        )
        self.depths = np.lib.format.open_memmap(
            folder / "depth.npy", "w+", np.float16, (total, HEIGHT // 2, WIDTH // 2)
        )
        self._focal, self._pose = np.zeros(total), np.zeros((total, 4, 4))
        self._overlap = np.zeros((total, int(counts.max())), dtype=np.float16)

    def rows(self, number: int) -> slice:
        """Where world ``number`` stands in the files."""
        start = int(self._counts[:number].sum())
        return slice(start, start + int(self._counts[number]))

    def add(self, number: int, poses: F64, focals: F64) -> None:
        """Where world ``number``'s views, whose pictures and depths are there, were taken from."""
        rows = self.rows(number)
        self._pose[rows], self._focal[rows] = poses, focals
        self._overlap[rows, : len(poses)] = overlaps(self.depths[rows], poses, focals)

    def close(self) -> None:
        """Writes what is not yet written."""
        self.images.flush()
        self.depths.flush()
        world = np.repeat(self._first + np.arange(len(self._counts)), self._counts)
        np.savez(
            self._folder / "views.npz", world=world, focal=self._focal, pose=self._pose, overlap=self._overlap
        )


def render_world(
    loop: bool, seed: int, images: NDArray[np.uint8], depths: NDArray[np.float16]
) -> list[View]:
    """Fills one world's pictures and depths, pair by pair; returns where each was taken."""
    rng = np.random.default_rng([seed, 100])
    plan = make_plan(loop, seed)
    built = build_world(plan, seed)
    textures = list(built.textures)
    walkers = [Walker.random(rng, lane, textures) for lane in plan.lanes[: int(rng.integers(0, 4))]]
    if rng.random() < 0.7:
        recolour(textures, rng)
    world = World(built.cells, textures, plan)
    # A renderer keeps the textures that it has shrunk, hence few cameras; crops make more of them later.
    renderers = [Renderer(world, camera(WIDTH * rng.uniform(0.5, 0.85))) for _ in range(_CAMERAS)]
    views: list[View] = []
    while len(views) < len(images):
        drawn = []
        for pose in pair(plan, rng):
            renderer = renderers[int(rng.integers(_CAMERAS))]
            view = View(pose, renderer.camera.fx)
            moving = walkers_at(walkers, float(rng.uniform(0, 300)))
            depth = renderer.depth(view.pose, moving)
            if depth.min() < _NEAREST:
                break
            picture = cv2.cvtColor(renderer.draw(view.pose, moving).pixels, cv2.COLOR_BGRA2RGB)
            half = cv2.resize(depth, depths.shape[:0:-1], interpolation=cv2.INTER_NEAREST)
            drawn.append((view, picture, half))
        if len(drawn) == 2:
            for view, picture, depth in drawn:
                images[len(views)], depths[len(views)] = picture, depth
                views.append(view)
    return views


def camera(focal: float) -> Camera:
    """An ideal pinhole of that focal length (pixels)."""
    return Camera(WIDTH, HEIGHT, focal, focal, (WIDTH - 1) / 2, (HEIGHT - 1) / 2)


def pair(plan: Plan, rng: np.random.Generator) -> list[F64]:
    """Poses (4, 4): a view from somewhere free, and another one near it that looks much the same way."""
    if plan.zone is not None:
        place = rng.uniform(plan.zone[0] - 0.2, plan.zone[1] + 0.2)
        yaw = rng.uniform(-np.pi, np.pi)
    else:
        row = int(rng.integers(len(plan.route)))
        ahead = plan.route[(row + 20) % len(plan.route)] - plan.route[row]
        yaw = np.arctan2(ahead[1], ahead[0])
        yaw += rng.uniform(-np.pi, np.pi) if rng.random() < 0.3 else rng.normal(0.0, 0.4)
        place = plan.route[row] + rng.uniform(-0.25, 0.25, 2)
    low = rng.random() < 0.3  # as a wheeled robot's camera
    height = rng.uniform(0.3, 0.9) if low else rng.normal(1.42, 0.15)
    pitch = rng.normal(0.0, 0.06) if low else rng.normal(-0.2, 0.25)
    roll = rng.normal(0.0, 0.02 if low else 0.1)
    out = []
    for _ in range(2):
        position = np.array([*place, np.clip(height, 0.25, 2.0)])
        out.append(looking(position, yaw, float(np.clip(pitch, -0.9, 0.6)), roll))
        place = place + rng.normal(0.0, 0.22, 2)
        if plan.zone is not None:
            place = np.clip(place, plan.zone[0] - 0.2, plan.zone[1] + 0.2)
        yaw, pitch = yaw + rng.normal(0.0, 0.2), pitch + rng.normal(0.0, 0.06)
        roll = roll + rng.normal(0.0, 0.04)
        height += rng.normal(0.0, 0.06)
    return out


def recolour(textures: list[NDArray[np.uint8]], rng: np.random.Generator) -> None:
    """Gives half of the surfaces other colours and another contrast, in place of their own."""
    for number, texture in enumerate(textures):
        if rng.random() < 0.5:
            continue
        mix = np.eye(4, dtype=np.float32)
        mix[:3, :3] = np.eye(3) * rng.uniform(0.6, 1.2) + rng.normal(0.0, 0.18, (3, 3))
        gain, gamma = 255.0, float(np.exp(rng.normal(0.0, 0.3)))
        curve = np.clip(gain * (np.arange(256) / 255.0) ** gamma, 0, 255).astype(np.uint8)
        textures[number] = cv2.transform(cv2.LUT(texture, curve), mix)


def overlaps(depths: NDArray[np.float16], poses: F64, focals: F64) -> NDArray[np.float64]:
    """Shares (n, n): of a grid of points that view i sees, how many view j sees too (not hidden)."""
    n, rows, columns = depths.shape
    step = rows // _GRID
    y, x = np.mgrid[step // 2 : rows : step, step // 2 : columns : step].reshape(2, -1)
    z = depths[:, y, x].astype(np.float64)
    half = columns / WIDTH
    f = focals[:, None] * half
    cx, cy = (columns - 1) / 2, (rows - 1) / 2
    points = np.stack([(x - cx) / f * z, (y - cy) / f * z, z, np.ones_like(z)], axis=1)  # (n, 4, k)
    out = np.zeros((n, n))
    for j in range(n):
        seen = np.einsum("ab,nbc,nck->nak", np.linalg.inv(poses[j]), poses, points)
        ahead = np.maximum(seen[:, 2], 1e-6)
        u = np.rint(seen[:, 0] / ahead * focals[j] * half + cx).astype(np.int64)
        v = np.rint(seen[:, 1] / ahead * focals[j] * half + cy).astype(np.int64)
        inside = (seen[:, 2] > 0.1) & (u >= 0) & (u < columns) & (v >= 0) & (v < rows)
        there = depths[j][np.where(inside, v, 0), np.where(inside, u, 0)].astype(np.float64)
        out[:, j] = np.mean(inside & (np.abs(there / ahead - 1.0) < 0.1), axis=1)
    return out


if __name__ == "__main__":
    main()
