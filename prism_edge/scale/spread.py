"""How far keyframes' observations lie from the estimate, learned as they come; and what of it the map has.

The filter is run with one noise model for every network and scene, and its gain needs no better one: a common
factor on all variances leaves it as it is. The uncertainty does need one. The variance that the pixels of a
keyframe share has an inverse-gamma belief, as of the unknown observational variance of a dynamic linear model
(West and Harrison 1997, section 4.5), which each observation sharpens by as much of it as is new. It rests
on the last hundred or so: the next room or the evening may have another.
"""

from __future__ import annotations

import math

PRIOR_WEIGHT = 4.0  # independent observations that the network's own word counts as
MOST_WEIGHT = 100.0  # that all which was learned counts as: a few minutes of them
USUAL_BIAS = 0.10  # of the network that frame_sigma was measured with; another's images spread in proportion
WAVER = 0.06  # of log scale: a map's own, from place to place; no source of depth is to blame for as much
TURNING = 0.10  # of log scale: of a map's own where it is made by turns on the spot, which tell no lengths
LOST_AT = 1.1  # times as wide as network and such a map could make it: metres are worth nothing then
LOST = 2.0  # of log scale: what they are off by; 0.3 to 3.6 were measured, 2.2 rms
_NOT_THE_MAP = 2.0  # times the network's variance: a few seconds hold about one draw of it
_MOST = 1.0  # of log scale: more is no wavering


class FrameSpread:
    """Standard deviation of what a keyframe shows about the estimate of log scale."""

    def __init__(self, prior: float) -> None:
        self._usual, self._at_most = max(prior, WAVER), math.hypot(prior, TURNING)
        self._weight = PRIOR_WEIGHT
        self._sum = PRIOR_WEIGHT * prior**2

    @property
    def weight(self) -> float:
        """Independent observations that the belief counts as."""
        return self._weight

    @property
    def sigma(self) -> float:
        """Root of the belief's mean variance."""
        return math.sqrt(self._sum / self._weight)

    @property
    def excess(self) -> float:
        """How many times as wide as was thought it surely is; 1 at least."""
        return max(self._surely / self._usual, 1.0)

    @property
    def lost_sigma(self) -> float:
        """Standard deviation of log scale that no bias on a card has: of a network that may be anywhere."""
        beyond = self._surely / self._at_most - 1.0
        return LOST * min(max(beyond / (LOST_AT - 1.0), 0.0), 1.0)

    @property
    def doubt(self) -> str:
        """What is to be said of the network, in words; empty where its images agree as it is thought to."""
        if self.lost_sigma == 0.0:
            return ""
        return (
            f"the network's images differ in size by {self.sigma:.2f} (log) where {self._usual:.2f} is usual "
            "for it: it may not know what it sees, and then metres are worth little (docs/TROUBLESHOOTING.md)"
        )

    @property
    def _surely(self) -> float:
        """``sigma``, less one sigma of what is known of it."""
        return self.sigma * (1.0 - 1.0 / math.sqrt(2.0 * self._weight))

    def take(self, residual: float, sigma: float, share: float) -> None:
        """An observation minus the estimate, which has ``sigma``; ``share`` in [0, 1] of it is new.

        The expected square of an observation about the truth is the residual's plus the estimate's variance,
        which the residual lacks: the estimate has gone towards the observation.
        """
        self._sum += share * min(residual * residual + sigma * sigma, _MOST)
        self._weight += share
        fading = min(MOST_WEIGHT / self._weight, 1.0)
        self._sum, self._weight = fading * self._sum, fading * self._weight


class LocalScale:
    """How far the map's scale here may be from the published one: what a network's errors don't explain.

    A map's scale wavers from place to place. There the observations leave the published value together, and
    by more than the network's own errors would make them.
    """

    def __init__(self) -> None:
        self._sum = self._weight = 0.0

    def take(self, residual: float, fading: float) -> None:
        """An observation minus what is published; ``fading`` in [0, 1] is left of what was seen before."""
        self._sum = fading * self._sum + min(residual * residual, _MOST)
        self._weight = fading * self._weight + 1.0

    def sigma(self, network: float) -> float:
        """Standard deviation of the log scale here; ``network`` is what the pixels of its images share."""
        if self._weight == 0.0:
            return 0.0
        return math.sqrt(max(self._sum / self._weight - _NOT_THE_MAP * network**2, 0.0))
