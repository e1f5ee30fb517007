"""What the tests of the tracker worker share: messages, a bus in memory, a small world with its truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from prism_edge.bus import ros
from prism_edge.config import Config, DepthConfig, TrackingConfig
from prism_edge.geometry.poses import inverse
from prism_edge.messages import (
    Depth,
    Frame,
    Keyframe,
    KeyframeImage,
    MapUpdate,
    Scale,
)
from prism_edge.workers import tracker as worker
from tests.tracking.footage import IDENTITY, footage
from tests.workers.list_bus import ListBus

CONFIG = Config(tracking=TrackingConfig(features=500), depth=DepthConfig(model="exact"))
LOCKSTEP = replace(CONFIG, mode="lockstep")
BASE_FROM_CAMERA = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
NONE = np.zeros(0, np.int64)


def frame(index: int, of: int | None = None, **changes: object) -> Frame:
    film = footage()
    made = Frame(
        index=index,
        stamp_ns=film.stamp_ns(index),
        captured_monotonic_ns=1000 + index,
        colour=False,
        duplicate=False,
        camera_model="pinhole",
        camera=film.camera.to_array(),
        image=film.images[index if of is None else of],
    )
    return replace(made, **changes)


def depth_of(image: KeyframeImage, of: int | None = None, **changes: object) -> Depth:
    made = Depth(
        keyframe=image.keyframe,
        index=image.index,
        stamp_ns=image.stamp_ns,
        epoch=image.epoch,
        model="exact",
        bias_sigma=0.0,
        inference_ms=1.0,
        valid=True,
        reason="",
        image_to_depth=IDENTITY,
        depth=footage().depths[image.index if of is None else of],
        confidence=np.zeros((0, 0), np.float32),
        descriptor=np.zeros(0, np.float32),
    )
    return replace(made, **changes)


def scale_of(keyframe: Keyframe, log_scale: float = 0.0, sigma: float = 0.05, **changes: object) -> Scale:
    made = Scale(
        keyframe=keyframe.id,
        index=keyframe.index,
        stamp_ns=keyframe.stamp_ns,
        epoch=keyframe.epoch,
        log_scale=log_scale,
        sigma=sigma,
        filter_sigma=sigma,
        observation=log_scale,
        observation_sigma=0.1,
        points=50,
        accepted=True,
    )
    return replace(made, **changes)


def update_of(keyframe: Keyframe, sequence: int = 1, poses: np.ndarray | None = None, **changes) -> MapUpdate:
    """An update that changes nothing, or puts the newest keyframe elsewhere."""
    made = MapUpdate(
        epoch=keyframe.epoch,
        sequence=sequence,
        based_on=keyframe.id,
        index=keyframe.index,
        loop_closed=False,
        solve_ms=1.0,
        keyframes=NONE if poses is None else np.array([keyframe.id]),
        poses=np.zeros((0, 4, 4)) if poses is None else poses,
        points=NONE,
        positions=np.zeros((0, 3)),
        parallax_deg=np.zeros(0, np.float32),
        dropped_keyframes=NONE,
        dropped_points=NONE,
    )
    return replace(made, **changes)


class World:
    """Depth, scale and backend as they answer the tracker; each answer can be changed or left out."""

    def __init__(self, bus: ListBus) -> None:
        self.bus = bus
        self.depth, self.scale, self.update = depth_of, scale_of, update_of
        bus.hear = self.heard

    def heard(self, topic: str, message) -> None:
        if topic == "keyframe_image" and self.depth is not None:
            self.bus.give("depth", self.depth(message))
        if topic == "keyframe":
            if self.scale is not None:
                self.bus.give("log_scale", self.scale(message))
            if self.update is not None:
                self.bus.give("map_update", self.update(message, sequence=message.id + 1))


def positions(bus) -> dict[int, np.ndarray]:
    """Published positions by frame."""
    film = footage()
    index = {film.stamp_ns(i): i for i in range(200)}
    return {index[ros.stamp_ns(m)]: ros.pose_matrix(m.pose.pose)[:3, 3] for m in bus.of("pose")}


def true_position(index: int) -> np.ndarray:
    return (BASE_FROM_CAMERA @ footage().poses[index] @ inverse(BASE_FROM_CAMERA))[:3, 3]


def run(bus, frames, config=CONFIG) -> None:
    bus.give("frame", *frames)
    worker.main(config, bus)
