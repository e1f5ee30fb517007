"""A walk along a straight line and back again, backwards: everything is seen twice, the same way round."""

from __future__ import annotations

import numpy as np

from prism_edge.geometry.poses import Array
from prism_edge.sources.sim.paths import Wander, looking


class ThereAndBack:
    """Someone walks with a camera in hand, looks ahead and a little about, and walks backwards again."""

    def __init__(
        self,
        rng: np.random.Generator,
        start: Array,
        end: Array,
        speed: float,
        sway: float,
        swing: float,
        pitch: float,
    ) -> None:
        """``start``, ``end`` (3,) m, of the eyes; ``speed`` is the mean, m/s.

        ``sway`` (m) is how far aside it goes at most, ``swing`` (rad) how far it looks aside, ``pitch``
        (rad) how far up on the mean.
        """
        self._start, self._way = start, end - start
        self._sway, self._swing, self._pitch = sway, swing, pitch
        self.period_s = 2.0 * float(np.linalg.norm(self._way)) / speed
        self._yaw = float(np.arctan2(self._way[1], self._way[0]))
        self._look = [Wander(rng, 0.06, 0.3) for _ in range(3)]
        self._place = [Wander(rng, 0.1, 0.5) for _ in range(2)]
        self._tremor = [Wander(rng, 0.8, 3.0) for _ in range(3)]
        self._stride = 2 * np.pi * 0.85 * max(speed, 0.3)

    def pose(self, seconds: float) -> Array:
        """world_from_camera (4, 4)."""
        share = 0.5 - 0.5 * np.cos(2 * np.pi * seconds / self.period_s)  # slow at both ends
        aside, up = (np.tanh(2.0 * place(seconds)) for place in self._place)
        yaw, pitch, roll = (np.tanh(1.6 * look(seconds)) for look in self._look)
        tremor = [0.01 * tremor(seconds) for tremor in self._tremor]
        left = np.array([-np.sin(self._yaw), np.cos(self._yaw), 0.0])
        step = 0.012 * np.sin(2 * self._stride * seconds)
        position = self._start + share * self._way + self._sway * aside * left
        position[2] += 0.04 * up + step
        return looking(
            position,
            self._yaw + self._swing * yaw + tremor[0],
            self._pitch + 0.15 * pitch + tremor[1],
            0.05 * roll + tremor[2],
        )
