"""A short film of the generated room, with its true path and exact depth, kept in memory."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from prism_edge.geometry.cameras import Camera
from prism_edge.geometry.poses import inverse
from tests.synthetic.render import Renderer
from tests.synthetic.scene import furnished_room, hand_held_path
from tests.synthetic.sequence import synthetic_camera

RATE_HZ = 30.0
IDENTITY = np.array([1.0, 0.0, 1.0, 0.0])  # image_to_depth: depth at the image's own size


@dataclass(frozen=True)
class Footage:
    """Frame i was taken at ``poses[i]``, relative to the first, and ``stamps[i]``."""

    camera: Camera
    images: list[np.ndarray]
    depths: list[np.ndarray]
    poses: list[np.ndarray]

    def stamp_ns(self, index: int) -> int:
        return round(index * 1e9 / RATE_HZ)


@lru_cache(maxsize=1)
def footage(frames: int = 75) -> Footage:
    """The first seconds of the hand-held path, 320 x 240."""
    camera = synthetic_camera(320, 240)
    renderer = Renderer(furnished_room(0), camera)
    path = hand_held_path(frames, RATE_HZ)
    drawn = [renderer.draw(pose) for pose in path]
    grain = np.random.default_rng(0).normal(0.0, 1.5, (480, 640))
    offsets = np.random.default_rng(1).integers(0, 240, (frames, 2))
    images = [
        np.clip(np.round(luma + grain[y : y + 240, x : x + 320]), 0, 255).astype(np.uint8)
        for (luma, _), (y, x) in zip(drawn, offsets, strict=True)
    ]
    return Footage(camera, images, [d for _, d in drawn], [inverse(path[0]) @ pose for pose in path])


@lru_cache(maxsize=2)
def other_room(frames: int = 60) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Images, depths and poses of a walk through a place that is nowhere in the film."""
    camera = footage().camera
    renderer = Renderer(furnished_room(5), camera)
    path = hand_held_path(frames, RATE_HZ)
    drawn = [renderer.draw(pose) for pose in path]
    return [
        (np.clip(np.round(luma), 0, 255).astype(np.uint8), depth, inverse(path[0]) @ pose)
        for (luma, depth), pose in zip(drawn, path, strict=True)
    ]
