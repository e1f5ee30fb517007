"""What the tests of drift share: a camera that makes keyframes along its way."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np

from prism_edge.config import CovarianceConfig
from prism_edge.messages import OK
from prism_edge.tracking.drift import Drift, Walk
from prism_edge.tracking.frame_result import FrameResult

CONFIG = CovarianceConfig(
    drift_of_motion=0.0, drift_per_sqrt_m=0.02, drift_per_sqrt_rad=0.01, turn_per_sqrt_m=0.0
)


def result(pose: np.ndarray, reference: int = -1, offset: np.ndarray | None = None) -> FrameResult:
    return FrameResult(OK, pose, np.zeros((6, 6)), reference, np.eye(4) if offset is None else offset, 100)


class World:
    """Keyframes along a way, each knowing the one before; as much of a local map as is asked for."""

    def __init__(self, drift: Drift, log_scale: float = 0.0) -> None:
        self.keyframes: dict[int, SimpleNamespace] = {}
        self.drift, self.log_scale = drift, log_scale
        self.last: np.ndarray | None = None

    def walk_to(self, number: int, pose: np.ndarray, neighbours: list[int], parallax: float = 1.0) -> None:
        """The camera goes there in a straight line; its keyframe's points have that parallax, degrees."""
        self.drift.advance(self.last, replace(result(pose), parallax_deg=parallax), self.log_scale)
        self.last = pose
        self.keyframes[number] = SimpleNamespace(id=number, world_from_camera=pose, neighbours=neighbours)
        for k in neighbours:
            self.keyframes[k].neighbours = [number, *self.keyframes[k].neighbours]
        self.drift.add_keyframe(self, self.keyframes[number], self.log_scale)

    def drift_at(self, number: int) -> Walk:
        pose = self.keyframes[number].world_from_camera
        self.drift.advance(None, result(pose, number), self.log_scale)
        return self.drift.here


def world_of(world: World, number: int, pose: np.ndarray) -> World:
    world.keyframes[number] = SimpleNamespace(id=number, world_from_camera=pose, neighbours=[])
    return world
