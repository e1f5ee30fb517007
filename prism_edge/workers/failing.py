"""How long a network has failed at every image, where only another process may mend it."""

from __future__ import annotations

from prism_edge.depth.providers import CPU
from prism_edge.errors import ModelError, PrismError

LONGEST_S = 20.0  # so that even one that fails soon after each start is never given up (supervisor.window_s)
LEAST = 3


class Failing:
    """Failures in a row of a network that runs on an accelerator.

    A process that has once lost its GPU (a driver's fault, a suspended computer) never gets it back, whatever
    it loads; one that is started again does, or runs the network on the next of ``depth.providers``.
    """

    def __init__(self, provider: str) -> None:
        """``provider`` as of a network: of a pair both, with a comma."""
        self._is_accelerated = provider != CPU
        self._provider = provider
        self._since_s = 0.0
        self._failures = 0

    def note(self, error: Exception | None, now_s: float) -> None:
        """What came of an image at ``now_s``, on a clock that never goes back: an error, or none.

        Raises ModelError once each image has failed for LONGEST_S, LEAST images at least. An error that
        prism_edge raises itself, of a picture or a file, says nothing of the accelerator.
        """
        if error is None or isinstance(error, PrismError):
            self._failures = 0
            return
        if not self._failures:
            self._since_s = now_s
        self._failures += 1
        failing_s = now_s - self._since_s
        if self._is_accelerated and self._failures >= LEAST and failing_s >= LONGEST_S:
            raise ModelError(
                f"{self._provider} has failed at {self._failures} images in {failing_s:.0f} s: starting anew"
            )
