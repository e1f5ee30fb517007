"""A furnished room seen by exact cameras: pictures and depth as a perfect run would have them."""

from __future__ import annotations

from functools import cache

import numpy as np

from prism_edge.geometry.poses import Array, transform
from prism_edge.reconstruction.look import F32, Look
from prism_edge.scale.gate import DepthView
from tests.synthetic.render import Renderer
from tests.synthetic.scene import Face, cuboid, distances, furnished_room, hand_held_path
from tests.synthetic.sequence import synthetic_camera

WIDTH, HEIGHT = 160, 120
CAMERA = synthetic_camera(WIDTH, HEIGHT)
COUNT, APART = 8, 12  # keyframes, and frames between them
SEED = 3


def faces() -> tuple[Face, ...]:
    return furnished_room(SEED)


@cache
def looks(with_box_in: int | None = None) -> dict[int, Look]:
    """The room by keyframe; in one of them something stands before the camera that is nowhere else."""
    poses = hand_held_path(COUNT * APART, 30.0)[::APART]
    made = {}
    for number, pose in enumerate(poses):
        there = list(faces())
        if number == with_box_in:
            low = transform(pose, np.array([[-0.1, -0.1, 0.7]]))[0]
            there += cuboid(np.random.default_rng(0), low - 0.12, low + 0.12)
        luma, depth = Renderer(there, CAMERA).draw(pose)
        view = DepthView(
            number, pose, CAMERA, depth, np.array([1.0, 0, 1.0, 0]), np.zeros((0, 0), np.float32), 1.0
        )
        made[number] = Look(view, luma, np.dstack([luma] * 3))
    return made


def all_others() -> dict[int, list[int]]:
    """Keyframes beside each, nearest in time first."""
    return {k: sorted(set(range(COUNT)) - {k}, key=lambda j: abs(j - k)) for k in range(COUNT)}


def wavering(look: Look, size: float = 0.08) -> Look:
    """The look with depths that are off as a network's are: smoothly, each picture otherwise."""
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH] / 60.0
    off = size * np.sin(x * (1.0 + 0.3 * look.view.keyframe) + 2.0 * look.view.keyframe) * np.cos(1.3 * y)
    return look.with_depth((look.view.depth * np.exp(off)).astype(np.float32))


def log_errors(depth: F32, number: int) -> Array:
    """Of depth (h, w) of a keyframe, where it has some."""
    there = depth > 0
    return np.log(depth[there] / looks()[number].view.depth[there])


def from_the_walls(points: Array) -> Array:
    """From points (n, 3) to the nearest face of the room (n,)."""
    return distances(points, faces())
