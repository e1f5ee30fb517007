"""What a stored map says of its unit, beside its arrays."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from prism_edge.backend.map_file import Info
from prism_edge.errors import MapError

LARGEST_LOG_SCALE = 20.0
UNKNOWN_SCALE_SIGMA = 0.3


@dataclass(frozen=True)
class KnownScale:
    """What is known of a map's unit: the logarithm of its metres, and its standard deviation.

    The bias of the network that it was learned from, and how lost that was (scale/spread.py), are told
    apart: a scale filter goes on from the rest.
    """

    log_scale: float = 0.0
    sigma: float = UNKNOWN_SCALE_SIGMA
    bias_sigma: float = 0.0
    network: str = ""  # that it was learned from, as its depths name it
    lost_sigma: float = 0.0

    @classmethod
    def of(cls, info: Info) -> KnownScale:
        """As a stored map says. Raises MapError where it says nothing that can be."""
        told = {"bias_sigma": 0.0, "lost_sigma": 0.0, "scale_by": "", **info}  # earlier builds' don't say
        network = told["scale_by"]
        if not isinstance(network, str):
            raise MapError("the map's scale_by is no network")
        log_scale = _number(told, "log_scale", -LARGEST_LOG_SCALE)
        sigma, bias = _number(told, "scale_sigma", 0.0), _number(told, "bias_sigma", 0.0)
        return cls(log_scale, sigma, bias, network, _number(told, "lost_sigma", 0.0))

    @property
    def whole_sigma(self) -> float:
        """Standard deviation of the logarithm, with all that is told apart."""
        return math.hypot(self.sigma, self.bias_sigma, self.lost_sigma)

    @property
    def is_known(self) -> bool:
        """Whether depth has said anything of the unit."""
        return self != KnownScale()

    @property
    def info(self) -> Info:
        """For a stored map."""
        known = {"log_scale": self.log_scale, "scale_sigma": self.sigma, "bias_sigma": self.bias_sigma}
        return {**known, "lost_sigma": self.lost_sigma, "scale_by": self.network}


def _number(info: Info, name: str, least: float) -> float:
    number: Any = info.get(name)
    if type(number) not in (int, float) or not least <= number < LARGEST_LOG_SCALE:  # true is an int, too
        raise MapError(f"the map's {name} is none")
    return float(number)
