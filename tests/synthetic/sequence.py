"""Writes a generated sequence as a TUM RGB-D folder."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from prism_edge.geometry.cameras import Camera
from prism_edge.geometry.poses import quaternion_from_rotation
from tests.synthetic.render import Renderer
from tests.synthetic.scene import furnished_room, hand_held_path
from tests.synthetic.tint import tinted

RATE_HZ = 30.0
DEPTH_UNITS = 5000  # a metre, in the layout's depth images


def synthetic_camera(width: int = 640, height: int = 480) -> Camera:
    """The sequence's camera: 525 pixels at 640 x 480, as recorded sequences have."""
    focal = 525.0 * width / 640.0
    return Camera(width, height, focal, focal, (width - 1) / 2.0, (height - 1) / 2.0)


def write_sequence(
    folder: Path, frames: int = 200, width: int = 640, height: int = 480, seed: int = 0, noise: float = 1.5
) -> Path:
    """Writes rgb/, depth/, rgb.txt, depth.txt, groundtruth.txt and camera.yaml; returns the folder.

    The same arguments give the same bytes. ``noise`` is the sigma of the luma's noise in grey levels. Depth
    is exact to the layout's 0.2 mm, poses to nine digits.
    """
    camera = synthetic_camera(width, height)
    renderer = Renderer(furnished_room(seed), camera)
    rng = np.random.default_rng([seed, 1])
    for name in ("rgb", "depth"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    lists: dict[str, list[str]] = {"rgb": [], "depth": []}
    truth = []
    grain = rng.normal(0.0, noise, (2 * height, 2 * width)).astype(np.float32)
    for i, pose in enumerate(hand_held_path(frames, RATE_HZ)):
        luma, depth = renderer.draw(pose)
        # A window into one field of noise: a new one for each frame would cost more than the rendering.
        dy, dx = rng.integers(0, height), rng.integers(0, width)
        noisy = np.clip(np.round(luma + grain[dy : dy + height, dx : dx + width]), 0, 255).astype(np.uint8)
        stamp = f"{i / RATE_HZ:.6f}"
        write = [cv2.IMWRITE_PNG_COMPRESSION, 1]
        cv2.imwrite(str(folder / "rgb" / f"{stamp}.png"), tinted(noisy, depth), write)
        units = np.round(depth * DEPTH_UNITS).astype(np.uint16)
        cv2.imwrite(str(folder / "depth" / f"{stamp}.png"), units, write)
        for name, lines in lists.items():
            lines.append(f"{stamp} {name}/{stamp}.png")
        numbers = (*pose[:3, 3], *quaternion_from_rotation(pose[:3, :3]))
        truth.append(" ".join([stamp, *(f"{number:.9f}" for number in numbers)]))
    for name, lines in lists.items():
        _write_lines(folder / f"{name}.txt", [f"# {name} images of a generated sequence", *lines])
    _write_lines(folder / "groundtruth.txt", ["# stamp tx ty tz qx qy qz qw (world_from_camera)", *truth])
    keys = ("width", "height", "fx", "fy", "cx", "cy")
    _write_lines(folder / "camera.yaml", [f"{key}: {getattr(camera, key)}" for key in keys])
    return folder


def _write_lines(path: Path, lines: list[str]) -> None:
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
