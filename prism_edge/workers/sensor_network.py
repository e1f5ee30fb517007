"""`--model sensor`: a depth camera's images in a network's place: what the rest makes of true depth."""

from __future__ import annotations

import logging
import math
import time

import numpy as np

from prism_edge.config import SENSOR, Config, SourceConfig
from prism_edge.depth import DepthNetwork, open_network
from prism_edge.depth.prediction import Prediction, checked, no_confidence, no_descriptor
from prism_edge.depth.providers import idle_options
from prism_edge.errors import ModelError, SourceError
from prism_edge.geometry.cameras import Camera
from prism_edge.named_path import named_path
from prism_edge.sources.address import shown_address
from prism_edge.sources.sensor_depth import SensorDepth, image_to_depth
from prism_edge.sources.sim import is_simulated
from prism_edge.sources.sim.depth_camera import SimulatedDepth

log = logging.getLogger("prism_edge.depth")


def depth_of(source: SourceConfig) -> SimulatedDepth | SensorDepth:
    """What a source carries of depth. Raises ModelError where that is nothing."""
    folder, simulated = named_path(source.uri), is_simulated(source.uri)
    needs = (
        "--model sensor needs a recording with depth images (TUM RGB-D, BONN or 7-Scenes) "
        "or a simulated world"
    )
    if not simulated and not folder.is_dir():
        raise ModelError(f"{shown_address(source.uri) or 'no source'}: {needs}")
    try:
        return SimulatedDepth(source.uri) if simulated else SensorDepth(folder)
    except SourceError as error:
        raise ModelError(f"{error}; {needs}") from None


class SensorNetwork:
    """What the depth worker takes for a network, and isn't one: with it the system is not monocular.

    A simulated world has exact depth. Raises ModelError where the source carries no depth images.
    """

    name = identity = "sensor (not monocular)"
    provider = "none"
    bias_sigma = 0.01  # of a depth camera's metres
    frame_sigma = 0.02  # what the pixels of one of its images share
    dsug = (math.nan, math.nan)  # the gate stays open: it was fitted for networks

    def __init__(self, source: SourceConfig) -> None:
        self._sensor = depth_of(source)
        # A recording that is looped begins again after as many images as are played of it.
        self._round = min(source.frames or len(self._sensor), len(self._sensor))
        self.counters: dict[str, int] = {}
        whose = "the simulator" if is_simulated(source.uri) else "the recording's own depth camera"
        log.warning("depth comes from %s: this run is not monocular", whose)

    def measure(self, index: int, camera: Camera) -> Prediction:
        """The depth image of a colour image that ``camera`` took; a looped recording counts on."""
        started = time.perf_counter()
        depth = self._sensor.in_colour(index % self._round, camera)
        if depth is None:
            depth = np.zeros((3, 3), np.float32)
        return checked(
            Prediction(
                depth,
                image_to_depth(depth, camera),
                no_confidence(),
                no_descriptor(),
                inference_ms=1e3 * (time.perf_counter() - started),
            )
        )


def open_depth(config: Config) -> DepthNetwork | SensorNetwork:
    """What ``depth.model`` names. Raises ModelError."""
    if config.depth.model == SENSOR:
        return SensorNetwork(config.source)
    for line in idle_options(config.depth):
        log.warning("%s", line)
    return open_network(config.depth.model, config.depth)
