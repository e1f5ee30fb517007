"""The published scale: it moves only when the estimate contradicts it, or slowly."""

from __future__ import annotations

import math

CREEP = 0.002  # of log scale with a keyframe: ten of them bend the live path by 2 %
MOST_SIGMA = 1.3  # times the network's bias: what is published should not be less certain than that


class SteadyScale:
    """Holds a value until the estimate is more than ``sigmas`` of its own uncertainty away, then follows.

    A change of scale bends the live trajectory, so it should say something. Within its uncertainty the
    estimate wanders as one view's error gives way to the next view's; that is no news of the scale. What is
    held differs from the best estimate by less than ``sigmas`` sigma, and that difference is part of the
    published uncertainty. Where it makes that large (:func:`lasting`), it goes by CREEP a keyframe. With
    ``sigmas`` 0 the estimate itself is published.
    """

    def __init__(self, sigmas: float) -> None:
        self._sigmas = sigmas
        self.log_scale = 0.0  # a map that starts from network depth has that unit by definition

    def follow(self, estimate: float, sigma: float, lasting: float = math.inf) -> float:
        """Take in a keyframe's estimate with its total sigma; returns the sigma of what is held.

        Beyond ``lasting`` of the estimate nothing is held for good.
        """
        slack = self._sigmas * sigma
        self.log_scale = min(max(self.log_scale, estimate - slack), estimate + slack)
        away = estimate - self.log_scale
        step = min(max(abs(away) - lasting, 0.0), CREEP)
        self.log_scale += math.copysign(step, away)
        return math.hypot(sigma, estimate - self.log_scale)


def lasting(sigma: float, bias_sigma: float) -> float:
    """How far from its estimate a scale of ``sigma`` (without the bias) may be held for good.

    So far that MOST_SIGMA times the bias is not exceeded; unlimited for a source that names no bias.
    """
    if not bias_sigma > 0.0:
        return math.inf
    return math.sqrt(max((MOST_SIGMA**2 - 1.0) * bias_sigma**2 - sigma**2, 0.0))
