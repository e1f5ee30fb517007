"""The published scale: it moves only when the estimate contradicts it."""

from __future__ import annotations


class SteadyScale:
    """Holds a value until the estimate is more than ``sigmas`` of its own uncertainty away, then follows.

    A change of scale bends the live trajectory, so it should say something. Within its uncertainty the
    estimate wanders as one view's error gives way to the next view's; that is no news of the scale. What is
    held differs from the best estimate by less than ``sigmas`` sigma, and that difference is part of the
    published uncertainty. With ``sigmas`` 0 the estimate itself is published.
    """

    def __init__(self, sigmas: float, log_scale: float = 0.0) -> None:
        self._sigmas = sigmas
        self.log_scale = log_scale  # 0: a map that starts from network depth has that unit by definition

    def follow(self, estimate: float, sigma: float, excess: float = 1.0) -> None:
        """Take in an estimate with its total sigma.

        With ``excess`` its network's images spread so many times as far as the network is thought to: metres
        of one that is out of its depth are worth less, and the shape of the path is worth as much as ever.
        """
        slack = self._sigmas * sigma * excess**2
        self.log_scale = min(max(self.log_scale, estimate - slack), estimate + slack)
