"""What `watch` shows, worked out from what has been heard: no I/O, times are given."""

from __future__ import annotations

import math
from collections import OrderedDict, deque
from dataclasses import dataclass, field

SPEED_S = 0.5  # speed is taken over this much of the recording
FIRST_S = 0.5  # the shortest time that a rate is told of
RATE_S = 2.0  # rate and latency over this much of the clock on the wall
QUIET_S = 3.0  # status comes twice a second: a daemon that is silent for so long has stopped, or is paused
_REMEMBERED = 256  # frames whose release is kept until their pose comes


@dataclass
class LiveView:
    """The latest of everything, and means over the last moments. None: not heard yet."""

    position: tuple[float, float, float] | None = None  # of the robot in `map` (m)
    stamp_ns: int = 0
    sigma_m: float | None = None  # of the position: root of the covariance's trace
    scale: float | None = None  # metres per map unit
    scale_sigma: float | None = None  # relative
    state: str = ""
    poses: int = 0
    _heard_s: float | None = None  # when the last status or pose came, by the clock on the wall
    _moved_s: float | None = None  # and the last odometry
    _track: deque[tuple[int, tuple[float, float, float]]] = field(default_factory=deque)
    _arrivals: deque[float] = field(default_factory=deque)
    _latencies: deque[tuple[float, float]] = field(default_factory=deque)
    _released: OrderedDict[int, int] = field(default_factory=OrderedDict)
    _waiting: OrderedDict[int, int] = field(default_factory=OrderedDict)

    def add_pose(
        self, stamp_ns: int, position: tuple[float, float, float], sigma_m: float, arrival_ns: int
    ) -> None:
        """A pose with its stamp, which came at ``arrival_ns`` of this host's monotonic clock."""
        self.poses += 1
        self.position, self.stamp_ns, self.sigma_m = position, stamp_ns, sigma_m
        now = self._heard_s = arrival_ns * 1e-9
        self._arrivals.append(now)
        while self._arrivals and now - self._arrivals[0] > RATE_S:
            self._arrivals.popleft()
        self._pair(stamp_ns, arrival_ns, self._waiting, self._released)

    def add_state(self, state: str, arrival_ns: int) -> None:
        """The words of `status`."""
        self.state, self._heard_s = state, arrival_ns * 1e-9

    def add_odometry(self, stamp_ns: int, position: tuple[float, float, float], arrival_ns: int) -> None:
        """A position in `odom`, where nothing jumps: what speed is taken from."""
        self._moved_s = arrival_ns * 1e-9
        if self._track and stamp_ns <= self._track[-1][0]:
            self._track.clear()  # the recording began again
        self._track.append((stamp_ns, position))
        while stamp_ns - self._track[0][0] > SPEED_S * 1e9:
            self._track.popleft()

    def add_release(self, stamp_ns: int, captured_ns: int) -> None:
        """When the frame with this stamp was captured, by the same monotonic clock as arrivals."""
        self._pair(stamp_ns, captured_ns, self._released, self._waiting)

    def rate_hz(self, now_ns: int) -> float | None:
        """Poses a second over the last moments; None while they are too few to tell.

        What waited while we came arrives in one burst, whose rate is nobody's.
        """
        recent = [t for t in self._arrivals if now_ns * 1e-9 - t <= RATE_S]
        if not recent and self._arrivals:
            return 0.0
        if len(recent) < 2 or recent[-1] - recent[0] < FIRST_S:
            return None
        return (len(recent) - 1) / (recent[-1] - recent[0])

    @property
    def speed(self) -> float | None:
        """Metres a second, by the recording's own time."""
        if len(self._track) < 2:
            return None
        (t0, p0), (t1, p1) = self._track[0], self._track[-1]
        return math.dist(p0, p1) / ((t1 - t0) * 1e-9)

    @property
    def latency_ms(self) -> float | None:
        """Median from capture to here over the last moments; None where the clocks can't be compared."""
        values = sorted(value for _, value in self._latencies)
        return values[len(values) // 2] if values else None

    def line(self, now_ns: int) -> str:
        """Everything on one line of plain text; what is not known is a dash."""
        x, y, z = self.position or (math.nan,) * 3
        parts = [f"t {self.stamp_ns * 1e-9:.3f}", f"x {x:+.3f} y {y:+.3f} z {z:+.3f} m"]
        return "  ".join(parts + [f"{name} {value}" for name, value in self.rows(now_ns)[2:]])

    def rows(self, now_ns: int) -> list[tuple[str, str]]:
        """Name and value of each line of the table; what changes by the moment is a dash once it is old."""
        now = now_ns * 1e-9
        moves = self._moved_s is not None and now - self._moved_s <= RATE_S
        flows = bool(self._latencies) and now - self._latencies[-1][0] <= RATE_S
        x, y, z = self.position or (math.nan,) * 3
        scale = "-" if self.scale is None else f"{self.scale:.3f}"
        if self.scale is not None and self.scale_sigma is not None:
            scale += f" ± {self.scale * self.scale_sigma:.3f}"
        return [
            ("time", f"{self.stamp_ns * 1e-9:.3f} s"),
            ("position", "-" if self.position is None else f"{x:+.3f} {y:+.3f} {z:+.3f} m"),
            ("sigma", _shown(self.sigma_m, "{:.3f} m")),
            ("speed", _shown(self.speed if moves else None, "{:.2f} m/s")),
            ("scale", scale),
            ("state", self._state(now)),
            ("rate", _shown(self.rate_hz(now_ns), "{:.1f} Hz")),
            ("latency", _shown(self.latency_ms if flows else None, "{:.1f} ms")),
        ]

    def _state(self, now_s: float) -> str:
        quiet_s = 0.0 if self._heard_s is None else now_s - self._heard_s
        if quiet_s <= QUIET_S:
            return self.state or "-"
        return f"nothing heard for {quiet_s:.0f} s" + (f"; last: {self.state}" if self.state else "")

    def _pair(
        self, stamp_ns: int, time_ns: int, mine: OrderedDict[int, int], other: OrderedDict[int, int]
    ) -> None:
        """Capture and arrival of one stamp come in either order; together they are a latency."""
        if stamp_ns not in other:
            mine[stamp_ns] = time_ns
            while len(mine) > _REMEMBERED:
                mine.popitem(last=False)
            return
        before_ns = other.pop(stamp_ns)
        latency_ms, now = abs(time_ns - before_ns) * 1e-6, max(time_ns, before_ns) * 1e-9
        self._latencies.append((now, latency_ms))
        while self._latencies and now - self._latencies[0][0] > RATE_S:
            self._latencies.popleft()


def _shown(value: float | None, form: str) -> str:
    return "-" if value is None or not math.isfinite(value) else form.format(value)
