"""Keyframes and depth maps of a made-up wall, for tests of the scale estimate."""

from __future__ import annotations

import numpy as np

from prism_edge.geometry.cameras import Camera
from prism_edge.messages import Depth, Keyframe
from tests.synthetic import messages
from tests.synthetic.messages import blank

CAMERA = Camera(640, 480, 500.0, 500.0, 319.5, 239.5)
SHAPE = (120, 160)
IMAGE_TO_DEPTH = np.array([0.25, -0.375, 0.25, -0.375])


def wall(rays: np.ndarray) -> np.ndarray:
    """Depth (m) of a slanted wall along rays (n, 2) on z = 1: the plane 0.1 x + 0.05 y + z = 2.5."""
    return 2.5 / (1.0 + 0.1 * rays[:, 0] + 0.05 * rays[:, 1])


def depth_of_wall(camera: Camera = CAMERA) -> np.ndarray:
    """What a perfect network gives for the raw image of that wall (h, w)."""
    y, x = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]].astype(np.float64)
    raw = np.column_stack([x.ravel(), y.ravel()])
    raw = (raw - IMAGE_TO_DEPTH[[1, 3]]) / IMAGE_TO_DEPTH[[0, 2]]
    return wall(camera.normalise(raw)).reshape(SHAPE).astype(np.float32)


def keyframe_of_wall(
    number: int,
    stamp_s: float,
    metres_per_unit: float = 1.0,
    points: int = 200,
    parallax_deg: float = 3.0,
    epoch: int = 0,
    camera: Camera = CAMERA,
) -> Keyframe:
    """A keyframe that sees the wall at ``points`` keypoints, its map in units of ``metres_per_unit``."""
    rng = np.random.default_rng(number)
    raw = rng.uniform((10, 10), (camera.width - 10, camera.height - 10), (points, 2))
    rays = camera.normalise(raw)
    return blank(
        Keyframe,
        id=number,
        index=10 * number,
        stamp_ns=round(stamp_s * 1e9),
        epoch=epoch,
        camera_model=camera.model,
        camera=camera.to_array(),
        world_from_camera=np.eye(4),
        pixels=(rays * (camera.fx, camera.fy) + (camera.cx, camera.cy)).astype(np.float32),
        octaves=np.zeros(points, np.uint8),
        descriptors=np.zeros((points, 32), np.uint8),
        points=np.arange(points, dtype=np.int64),
        depths=(wall(rays) / metres_per_unit).astype(np.float32),
        parallax_deg=np.full(points, parallax_deg, np.float32),
    )


def depth_of(keyframe: Keyframe, factor: float = 1.0, camera: Camera = CAMERA, **changes: object) -> Depth:
    """The network's depth of a keyframe: the wall's times ``factor``."""
    depth = depth_of_wall(camera) * np.float32(factor)
    said = {"model": "wall", "bias_sigma": 0.1, **changes}
    return messages.depth_of(keyframe, depth, IMAGE_TO_DEPTH.copy(), **said)
