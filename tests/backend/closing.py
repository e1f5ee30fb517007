"""What the tests of loop closing share: a mapper that hears of a ring, and a map of two parts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from prism_edge.backend.loop_closing import LoopCloser
from prism_edge.backend.mapper import Mapper
from prism_edge.config import BackendConfig
from prism_edge.messages import F32
from tests.backend.ring import Ring
from tests.backend.world import chain
from tests.tracking.cloud import pose_at

CONFIG = BackendConfig()
DRIFT = np.array([0.012, 0.006, -0.012, 0.002, -0.004, 0.002])


def walk(
    ring: Ring,
    count: int,
    places: bool = True,
    mapper: Mapper | None = None,
    odometer: float = 1.0,
    unheard: range = range(0),
) -> Mapper:
    """A mapper that has heard ``count`` keyframes, but for some, and closed what loops there were."""
    mapper = mapper or Mapper(CONFIG, use_depth=False)
    for message in ring.keyframes(count):
        if message.id in unheard:
            continue
        far = replace(message, travelled=odometer * message.travelled)
        hear(mapper, ring, far, ring.looks_like(message.id) if places else None)
    return mapper


def hear(mapper: Mapper, ring: Ring, message, descriptor: F32 | None) -> None:
    mapper.absorb(message)
    if descriptor is not None:
        mapper.loops.add_place(message.id, descriptor)
    mapper.loops.look(message.id)


def finish(mapper: Mapper) -> None:
    while mapper.loops.unfinished:
        mapper.loops.adjust(1.0)


def two_parts() -> LoopCloser:
    world = chain([pose_at(0.3 * i) for i in range(6)])
    return LoopCloser(chain([pose_at(50.0 + 0.3 * i) for i in range(4)], 100, world), CONFIG, False)
