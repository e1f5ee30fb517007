"""Networks of any kind for work after the run, where a finished map gives their depth its metres."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from prism_edge.config import DepthConfig
from prism_edge.depth import DepthNetwork, locate, networks_of, open_network, open_onnx, pinned_for
from prism_edge.depth.cards import card_of
from prism_edge.depth.prediction import Prediction
from prism_edge.depth.session import OnnxNetwork
from prism_edge.depth.several_views import SeveralViewsNetwork
from prism_edge.depth.vetting import vet
from prism_edge.geometry.cameras import Camera


class UnscaledNetwork:
    """A relative network, as it is: its answers are depth, or inverse depth, in no unit."""

    def __init__(self, network: OnnxNetwork) -> None:
        self._network = network
        self.kind = network.card.depth_kind
        self.name, self.identity, self.provider = network.name, network.identity, network.provider
        self.bias_sigma, self.dsug, self.counters = network.bias_sigma, network.dsug, network.counters

    def infer(self, rgb: NDArray[np.uint8], camera: Camera) -> Prediction:
        """What it says of an image (height, width, 3) uint8 RGB, unchecked; nan for nothing."""
        return self._network.raw(rgb)[0]


def open_offline(spec: str, config: DepthConfig) -> DepthNetwork | SeveralViewsNetwork:
    """The network that ``spec`` names, of any kind and number of views. Raises ModelError."""
    if len(networks_of(spec)) == 2:
        return open_network(spec, config)
    network = open_file(spec, config)
    if isinstance(network, SeveralViewsNetwork) or network.card.has_metres:
        return network
    return UnscaledNetwork(network)


def open_file(spec: str, config: DepthConfig) -> OnnxNetwork | SeveralViewsNetwork:
    """One network by file or registered name, of any kind and number of views. Raises ModelError."""
    path = locate(spec)
    pinned = pinned_for(spec, path)
    if card_of(path, vet(path, pinned[0].sha256 if pinned else ""), pinned).views > 1:
        return SeveralViewsNetwork(path, config, pinned)
    return open_onnx(spec, config)
