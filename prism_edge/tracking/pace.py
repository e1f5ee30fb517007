"""When images were taken that are stamped by when they came: some come together that were not taken so."""

from __future__ import annotations

from collections import deque

USUAL_S, WHOLE_S = 1.0, 0.9  # over so long the usual interval is looked for; from which on it is known
GAP_S = 0.5  # after which it is looked for anew: images that waited come in a burst
FEWEST = 5  # images that tell it
TOGETHER = 0.25  # of it: images that are less apart were not taken so; a camera may change its rate


class Pace:
    """Follows the numbers and stamps of images.

    ``step_s`` is how long the last step took by how many images there were lately, 0 where stamps are to be
    believed; ``since_ns`` the stamp that it began with, ``longest_s`` the longest as stamped lately.
    ``usual_s`` is from one image to the next, 0 where that isn't known yet.
    """

    def __init__(self) -> None:
        self.step_s = self.longest_s = self.usual_s = 0.0
        self.since_ns = 0
        self._known_s = 0.0  # the usual interval, as it was last seen for long enough
        self._seen: deque[tuple[int, int]] = deque()  # numbers and stamps
        self._steps: deque[tuple[int, int]] = deque()  # between these: ns, images

    def see(self, index: int, stamp_ns: int) -> None:
        """An image has come."""
        self.step_s = self.longest_s = self.usual_s = 0.0
        if self._seen:
            last, self.since_ns = self._seen[-1]
            if index <= last or not 0 < stamp_ns - self.since_ns <= GAP_S * 1e9:
                self._seen.clear()
                self._steps.clear()
            else:
                self._steps.append((stamp_ns - self.since_ns, index - last))
        self._seen.append((index, stamp_ns))
        while stamp_ns - self._seen[0][1] > USUAL_S * 1e9:
            self._seen.popleft()
            self._steps.popleft()
        if len(self._seen) < FEWEST:
            return
        first, began_ns = self._seen[0]
        usual = 1e-9 * (stamp_ns - began_ns) / (index - first)
        if stamp_ns - began_ns >= WHOLE_S * 1e9:
            self._known_s = usual
        self.usual_s = usual = max(usual, self._known_s)
        least_ns = min(took_ns / images for took_ns, images in self._steps)
        if self._known_s and least_ns < TOGETHER * usual * 1e9:
            self.step_s = usual * self._steps[-1][1]
            self.longest_s = 1e-9 * max(took_ns for took_ns, _ in self._steps)
