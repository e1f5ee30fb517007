"""What a network keeps of itself that is shown other pictures than the camera takes."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from prism_edge.depth import DepthNetwork


class ShownOtherwise:
    """A network in all but its pictures, and in its identity, which ends in ``mark``.

    What it sees and says of a place is another than without: neither is compared with the other.
    """

    def __init__(self, network: DepthNetwork, mark: str) -> None:
        self._network = network
        self.name, self.provider, self.identity = network.name, network.provider, network.identity + mark
        self.bias_sigma, self.dsug, self.counters = network.bias_sigma, network.dsug, network.counters
