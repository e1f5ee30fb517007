"""When a process that died is started again, and when it is given up."""

from __future__ import annotations

from collections import deque

from prism_edge.config import SupervisorConfig

LONGEST_PAUSE_S = 10.0  # doubling stops here: a robot waits for this process


def least_s(config: SupervisorConfig) -> float:
    """Seconds that the pauses before ``max_restarts`` restarts take.

    Where they take longer than the window, a process that keeps dying is never given up.
    """
    return sum(_pause_s(config, deaths) for deaths in range(1, config.max_restarts + 1))


def _pause_s(config: SupervisorConfig, deaths: int) -> float:
    # The exponent is bounded as well: 2.0 ** 1024 overflows.
    return min(config.backoff_s * 2.0 ** min(deaths - 1, 30), LONGEST_PAUSE_S)


class RestartPolicy:
    """Back-off for one process: the pause doubles with each death that is still within the window."""

    def __init__(self, config: SupervisorConfig) -> None:
        self._config = config
        self._deaths: deque[float] = deque()

    def configure(self, config: SupervisorConfig) -> None:
        """Other limits from now on; past deaths still count."""
        self._config = config

    def died(self, now_s: float) -> float | None:
        """Seconds to wait before starting again after a death at ``now_s``; None: give up.

        ``now_s`` is on any clock that never goes back. A process may die ``max_restarts`` times
        within ``window_s``; deaths older than that are forgotten.
        """
        while self._deaths and now_s - self._deaths[0] > self._config.window_s:
            self._deaths.popleft()
        self._deaths.append(now_s)
        if len(self._deaths) > self._config.max_restarts:
            return None
        return _pause_s(self._config, len(self._deaths))
