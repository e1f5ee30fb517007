"""Whether a camera is lost, and for how long it has looked about since."""

from __future__ import annotations

from collections import deque

from prism_edge.tracking.motion import LONGEST_S

MOST_BETWEEN_NS = 200_000_000  # what one frame adds to how long a lost camera has looked about
LAPSE = 3  # times the usual interval, which a camera's pace does not explain
USUAL = 5  # intervals, of which the one in the middle is usual


class Search:
    """Follows the images of one camera, which is lost or not."""

    def __init__(self) -> None:
        self.lost = False
        self.at_ns = 0  # the last image that it looked at
        self._looked_ns = 0  # since it is lost
        self._intervals_ns = deque[int](maxlen=USUAL)  # between the last images

    def begin(self, stamp_ns: int = 0) -> None:
        """It is lost, with an image of then."""
        self.lost, self._looked_ns, self.at_ns = True, 0, stamp_ns

    def look(self, stamp_ns: int, shows: bool) -> None:
        """A lost camera's image shows something, or darkness."""
        if shows:
            self._looked_ns += min(stamp_ns - self.at_ns, MOST_BETWEEN_NS)
        self.at_ns = stamp_ns

    @property
    def looked_s(self) -> float:
        """How long it has shown something since it was lost."""
        return self._looked_ns * 1e-9

    def lapsed(self, since_ns: int) -> bool:
        """Whether images failed to come for so long that no motion reaches this one; once for each image.

        Of a slow camera all images are far apart.
        """
        usual = sorted(self._intervals_ns)[len(self._intervals_ns) // 2] if self._intervals_ns else 0
        self._intervals_ns.append(since_ns)
        return since_ns > max(LONGEST_S * 1e9, LAPSE * usual)
