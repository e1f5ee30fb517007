"""What tracker and scale are told of a map that was loaded, or taken up from an earlier run."""

from __future__ import annotations

import time

from prism_edge.backend.map_scale import KnownScale
from prism_edge.backend.mapper import Mapper
from prism_edge.bus.session import Bus
from prism_edge.messages import MapLoaded

_AGAIN_S = 1.0


class LoadedMap:
    """Tells of the map that a mapper holds, and again where the tracker has not heard."""

    def __init__(self, bus: Bus, mapper: Mapper) -> None:
        self._bus, self._mapper = bus, mapper
        self._epoch, self._told_s = -1, float("-inf")

    def tell(self, known: KnownScale) -> None:
        """Others are to go on in it; ``known`` is of its unit."""
        self._epoch, self._told_s = self._mapper.epoch, time.monotonic()
        self._bus.publish("map_loaded", self.news(known))

    def remind(self, known: KnownScale) -> None:
        """A keyframe of the map before has come: on its way since, or of a tracker that was not reached."""
        if self._mapper.epoch == self._epoch and time.monotonic() > self._told_s + _AGAIN_S:
            self.tell(known)

    def news(self, known: KnownScale) -> MapLoaded:
        """The message."""
        told = known.log_scale, known.sigma, known.bias_sigma, known.network, known.is_known
        return MapLoaded(self._mapper.epoch, *told, known.lost_sigma)
