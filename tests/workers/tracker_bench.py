"""What the tests of the tracker worker share: messages, a bus in memory, a small world with its truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from prism_edge.bus import ros
from prism_edge.config import Config, DepthConfig, TrackingConfig
from prism_edge.geometry.poses import inverse
from prism_edge.messages import Depth, Frame, Keyframe, KeyframeImage, MapUpdate
from prism_edge.workers import tracker as worker
from tests.synthetic import messages
from tests.synthetic.messages import scale_of
from tests.tracking.footage import IDENTITY, footage
from tests.workers.list_bus import ListBus

CONFIG = Config(tracking=TrackingConfig(features=500), depth=DepthConfig(model="exact"))
LOCKSTEP = replace(CONFIG, mode="lockstep")
BASE_FROM_CAMERA = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])


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
    depth = footage().depths[image.index if of is None else of]
    return messages.depth_of(image, depth, IDENTITY, **changes)


def update_of(keyframe: Keyframe, sequence: int = 1, poses: np.ndarray | None = None, **changes) -> MapUpdate:
    """An update that changes nothing, or puts the newest keyframe elsewhere."""
    moved = {} if poses is None else {"keyframes": np.array([keyframe.id]), "poses": poses}
    told = {"epoch": keyframe.epoch, **moved, **changes}
    return messages.map_update(keyframe.id, sequence, **told)


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
