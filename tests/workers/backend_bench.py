"""What the tests of the backend worker share: the messages that it hears, of a cloud with its truth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from prism_edge.config import Config, DepthConfig
from prism_edge.geometry.poses import inverse, transform
from prism_edge.messages import IDS_A_LIFE, Depth, Gate, Keyframe, MapSnapshot, Scale
from prism_edge.workers.backend import BackendWorker
from tests.backend.world import Teller
from tests.synthetic import messages
from tests.tracking.cloud import pose_at
from tests.workers.list_bus import ListBus

CONFIG = Config(depth=DepthConfig(model="exact"))
LOCKSTEP = replace(CONFIG, mode="lockstep")
NO_DEPTH = Config()
QUARTER = np.array([0.25, 0.0, 0.25, 0.0])  # image_to_depth: a pixel of depth for four by four


def keyframes(count: int, epoch: int = 0, first: int = 0, seed: int = 0) -> tuple[Teller, list[Keyframe]]:
    teller = Teller(seed=seed, epoch=epoch, noise_px=0.3, first=first)
    return teller, [teller.keyframe(pose_at(0.2 * i, 0.0, 0.0, 0.0, -0.03 * i)) for i in range(count)]


def depth_of(keyframe: Keyframe, teller: Teller, **changes: object) -> Depth:
    """A depth map in which each keypoint finds its own depth (each in a patch of its own, roughly)."""
    depth = np.full((120, 160), 3.0, np.float32)
    pose = teller.poses[keyframe.id - teller.first]
    local = transform(inverse(pose), teller.cloud.positions[keyframe.points])
    for (x, y), z in zip(np.rint(keyframe.pixels / 4).astype(int), local[:, 2], strict=True):
        depth[max(y - 1, 0) : y + 2, max(x - 1, 0) : x + 2] = z
    return messages.depth_of(keyframe, depth, QUARTER, **changes)


def scale_of(keyframe: Keyframe, log_scale: float = 0.1, **changes: object) -> Scale:
    return messages.scale_of(keyframe, log_scale, 0.1, **changes)


def gate_of(keyframe: Keyframe, weight: float = 1.0) -> Gate:
    """Open, but for the second keypoint's ``weight``."""
    count = len(keyframe.pixels)
    weights = np.ones(count, np.float32)
    weights[1] = weight
    known = np.full(count, 0.3, np.float32)
    known[0] = np.nan
    return Gate(keyframe.id, keyframe.epoch, weights, known)


def hear(
    made: BackendWorker,
    bus: ListBus,
    told: list[Keyframe],
    teller: Teller,
    log_scale: float = 0.25,
    metric: bool = True,
) -> None:
    """Keyframes as they come in real time, each with all that belongs to it, solved one by one."""
    for keyframe in told:
        bus.give("depth", depth_of(keyframe, teller))
        bus.give("gate", gate_of(keyframe))
        bus.give("log_scale", scale_of(keyframe, log_scale, bias_sigma=0.07, metric=metric))
        bus.give("keyframe", keyframe)
        made._realtime()


def snapshot(bus: ListBus) -> MapSnapshot:
    return bus.answers["map_snapshot"]()


def live(
    folder: Path,
    told: list[Keyframe],
    teller: Teller,
    life: int = 0,
    config: Config = CONFIG,
    ask: tuple[str, ...] = (),
) -> ListBus:
    """One life of a backend with its run's folder, which hears some keyframes and a command for each name."""
    bus = ListBus("keyframe")
    bus.life, bus.first_id, bus.run_directory = life, life * IDS_A_LIFE, folder
    made = BackendWorker(config, bus)
    hear(made, bus, told, teller)
    for name in ask:
        bus.desk.ask("save_map", name)
    made._desk.serve()
    made._show()
    return bus
