"""A live camera that does what a test says."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from prism_edge.geometry.cameras import Camera
from prism_edge.sources.live.camera import Timing
from prism_edge.sources.live.driver import Grab

DEADLINE_S = 30.0
CAMERA = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)
QUICK = Timing(absent_s=0.3, first_pause_s=0.01, longest_pause_s=0.02, read_s=0.05)


def picture(seed: int = 0, width: int = 64, height: int = 48) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 255, (height, width, 3), dtype=np.uint8)


class Bench:
    """Driver and connection in one; ``script`` says what each grab gives."""

    name, period_ns, dead_s = "the bench", 1_000_000, 0.2  # only who gives nothing is held to the last
    connect_s = 0.0
    intrinsics: Camera | None = None

    def __init__(self, script: Callable[[int], Grab | None]) -> None:
        self._script, self.grabs = script, 0
        self.connects = self.closes = 0
        self.refusal: Exception | None = None

    def connect(self) -> Bench:
        if self.refusal is not None:
            raise self.refusal
        self.connects += 1
        return self

    def grab(self) -> Grab | None:
        self.grabs += 1
        grab = self._script(self.grabs)
        if grab is None:
            time.sleep(0.005)  # what a wait for the device takes
        return grab

    def close(self) -> None:
        self.closes += 1


def steady(_: int) -> Grab:
    time.sleep(0.002)
    now = time.monotonic_ns()
    return Grab(now, lambda: picture(now % 1000))
