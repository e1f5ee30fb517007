"""Kalman filter of log scale whose observations err alike when they are close in time (paper, section 3.3).

Keyframe k shows  z_k = x_k + f_k + n_k  with

- x: log metres per map unit as this network sees it, a slow random walk with distance and time. It includes
  the network's mean error on this scene, which no averaging removes: the estimator adds it back;
- f: the error that all pixels of a keyframe share, a stationary Gauss-Markov process (AR(1) when sampled)
  with standard deviation frame_sigma and time constant correlation_s. Because f is part of the state, a
  hundred keyframes of one place count as the few that they are worth;
- n: what is left of the pixels' own errors, white, with the least-squares' point variance, and what an image
  that scatters more than usual adds to f.

The unit of a map that starts from network depth is that depth: z is 0 by definition at that moment, hence
x = -f there, known as well as f is: P = frame_sigma^2 [[1, -1], [-1, 1]] (see :meth:`ScaleFilter.fix_unit`).
"""

from __future__ import annotations

import copy
import math
from collections import deque

import numpy as np

from prism_edge.config import ScaleConfig
from prism_edge.geometry.poses import Array
from prism_edge.scale.least_squares import Observation
from prism_edge.scale.spread import PRIOR_WEIGHT, FrameSpread

# A belief that rests on n observations falls to as many that contradict it and agree with one another,
# at least the first number of them and at most the second.
REOPEN_AFTER = (5, 30)
CONTESTED_AFTER = 3  # of them it is in doubt, the more the more of them have come
SAID_FROM = 0.5  # of lost_sigma that was only told
TOLD = "metres are those of a network that did not know what it saw: worth little (docs/TROUBLESHOOTING.md)"
_LEAST_VARIANCE = 1e-12  # float32 depths know no better; keeps the update from dividing 0 by 0
_OF_X, _OF_BOTH = np.array([1.0, 0.0]), np.ones(2)  # what is observed of the state: x, or x + f
_LATE_S = 300.0  # the longest that a depth may come late by: a queue's worth of keyframes
_LONGEST_WALK_S = 3600.0  # between two keyframes, that scale is thought to have walked for
_MAX_LOG = 20.0  # e^20 metres a unit: beyond any map


class ScaleFilter:
    """Log scale over time, in one epoch of the map. Never raises, never turns NaN."""

    def __init__(self, config: ScaleConfig, kalman: bool = True, begins_at: float = 0.0) -> None:
        """``begins_at`` is the log scale that the map's first depth is turned to its unit with.

        ``kalman=False`` is the ablation 'kalman': the last observation is the estimate.
        """
        self._config = config
        self._kalman = kalman
        self.accepted = 0  # observations
        self._support = 0  # observations that the present belief rests on
        self._unit_fixed = self._taken_over = False
        self._contradicting: deque[float] = deque(maxlen=REOPEN_AFTER[1])
        self.contested_sigma = 0.0  # what x may be off by, where observations refused in a row agree
        self._begins_at = begins_at
        self._state = np.array([begins_at, 0.0])  # x, f
        self._covariance = np.diag([config.initial_sigma**2, config.frame_sigma**2])
        self._time_s: float | None = None
        self._travelled = 0.0
        self._thought = config.frame_sigma  # that the network at hand spreads
        self._spread = FrameSpread(self._thought)
        self._told_lost = 0.0  # by who knew the unit before
        self._elapsed_s = 0.0  # since the last observation that the spread has

    @property
    def log_scale(self) -> float:
        """The estimate of x."""
        return float(self._state[0])

    @property
    def sigma(self) -> float:
        """Standard deviation of ``log_scale``, without the network's bias."""
        return math.sqrt(max(float(self._covariance[0, 0]), 0.0))

    @property
    def learned_sigma(self) -> float:
        """``sigma`` with the spread that this network's observations have here in place of the model's."""
        return self.sigma * self._learned

    @property
    def _learned(self) -> float:
        """How wide the observations spread over the model."""
        model = self._config.frame_sigma
        return self._spread.sigma / model if self._kalman and model > 0.0 else 1.0

    @property
    def excess(self) -> float:
        """How many times as far as was thought this network's images surely spread; 1 at least."""
        return self._spread.excess if self._kalman else 1.0

    @property
    def lost_sigma(self) -> float:
        """What metres may be off by where this network doesn't know what it sees; 0 where it does.

        What was known of that before counts for the less, the more has been seen since.
        """
        if not self._kalman:
            return 0.0
        return max(self._spread.lost_sigma, self._told_lost * PRIOR_WEIGHT / self._spread.weight)

    @property
    def doubt(self) -> str:
        """What is to be said of that, in words; empty for nothing."""
        return self._spread.doubt or (TOLD if self.lost_sigma > SAID_FROM else "")

    def expect(self, frame_sigma: float) -> None:
        """What the network at hand is thought to spread; heard before anything has been seen of it."""
        if self._is_unseen:
            learned, self._spread = self.learned_sigma, FrameSpread(frame_sigma)
            self._thought = frame_sigma
            if self._taken_over and self.learned_sigma > 0.0:  # what was known stays as well known
                self._covariance[0, 0] *= (learned / self.learned_sigma) ** 2

    def assume(self, config: ScaleConfig) -> None:
        """Another model of the noise; heard before anything has been seen of the network at hand."""
        if self._is_unseen:
            sigma = self.learned_sigma if self._taken_over else config.initial_sigma
            self._covariance = np.diag([sigma**2, config.frame_sigma**2])
            self._config, self._spread = config, FrameSpread(config.frame_sigma)
            self._thought = config.frame_sigma

    def correlation(self, elapsed_s: float) -> float:
        """Of what the pixels of a keyframe share with those of another, so long apart."""
        time_constant = self._config.correlation_s
        return math.exp(-elapsed_s / time_constant) if time_constant > 0.0 else 0.0

    @property
    def is_open(self) -> bool:
        """Whether nothing, neither unit nor observation, has come yet."""
        return not self._unit_fixed and self.accepted == 0

    @property
    def _is_unseen(self) -> bool:
        """Whether nothing has come of the network at hand, though another may have been gone on from."""
        return self.accepted == 0 and (self._taken_over or not self._unit_fixed)

    def predict(self, time_s: float, travelled: float) -> None:
        """Moves on to a time (s) and a path length since the start (map units)."""
        if self._time_s is None:
            if math.isfinite(time_s) and math.isfinite(travelled):
                self._time_s, self._travelled = time_s, travelled
            return
        elapsed = _step(time_s - self._time_s)
        metres = _step(travelled - self._travelled) * math.exp(min(max(self.log_scale, -_MAX_LOG), _MAX_LOG))
        # Where a depth came late, what lies between has been added, and must not be again.
        if math.isfinite(time_s) and not is_late(self._time_s - time_s):
            self._time_s = time_s
        self._travelled = max(self._travelled, travelled) if math.isfinite(travelled) else self._travelled
        self._elapsed_s += elapsed
        c = self._config
        phi = self.correlation(elapsed)
        transition = np.diag([1.0, phi])
        # A clock that was set forward by years is no reason to forget a scale.
        waited = min(elapsed, _LONGEST_WALK_S)
        walk = min(c.drift_per_sqrt_m**2 * metres + c.drift_per_sqrt_s**2 * waited, _MAX_LOG**2)
        noise = np.diag([walk, c.frame_sigma**2 * (1.0 - phi * phi)])
        self._state = transition @ self._state
        self._covariance = transition @ self._covariance @ transition + noise
        # a belief this wide is none; unbounded, steps without end would overflow it
        if self._covariance[0, 0] > _MAX_LOG**2:
            self._covariance = np.diag([_MAX_LOG**2, float(self._covariance[1, 1])])

    def resume(self, travelled: float) -> None:
        """The camera is back in this part of the map: the way since was gone in another, in its unit."""
        self._travelled += _step(travelled - self._travelled)

    def fix_unit(self) -> None:
        """The map's unit has just been defined by network depth: now, x + f is known whatever the two are.

        The limit of an exact observation of it on an unlimited prior of x. What the seeded pixels don't share
        with the triangulated ones that later observations use adds to x as if seen by the fewest points.
        """
        shared = self._config.frame_sigma**2
        own = self._config.point_sigma**2 / self._config.min_points
        self._state = np.array([self._begins_at, 0.0])
        self._covariance = np.array([[shared + own, -shared], [-shared, shared]])
        self._unit_fixed = True
        self._elapsed_s = 0.0

    def take_over(self, log_scale: float, sigma: float, lost_sigma: float = 0.0) -> None:
        """Begin with what an earlier run knew of this map's unit, and of how lost its network was."""
        known = min(max(sigma, 1e-3), _MAX_LOG)
        self._state = np.array([log_scale, 0.0])
        self._covariance = np.diag([known**2, self._config.frame_sigma**2])
        self._unit_fixed = self._taken_over = True
        self._told_lost = lost_sigma

    def meet_another(self, bias_sigma: float, frame_sigma: float, config: ScaleConfig) -> None:
        """Another network has other metres, by ``bias_sigma`` of both and by how lost the one before may be.

        Its images are thought to spread by ``frame_sigma``, and ``config`` is the model for them; what the
        other's shared says nothing of them.
        """
        known = math.hypot(self.learned_sigma, bias_sigma, self.lost_sigma)
        self._config, self._thought, self._spread = config, frame_sigma, FrameSpread(frame_sigma)
        self._state[1], self._told_lost = 0.0, 0.0
        self._contradicting.clear()  # in the other's metres
        self.contested_sigma = 0.0
        self._covariance = np.diag([(known / (self._learned or 1.0)) ** 2, self._config.frame_sigma**2])

    def widen(self, sigma: float) -> None:
        """What is known may be off by so much more."""
        self._covariance = self._covariance + np.diag([sigma**2, 0.0])

    def joined(self, other: ScaleFilter, log_unit: float, sigma: float) -> ScaleFilter:
        """Both in one, now that another part of the map is in this one's unit.

        ``log_unit`` is the log of the other's unit in this one's, known to ``sigma``. The images of either
        are taken to err independently of the other's; f is that of whom an image has come to since.
        """
        if other.is_open or not self._kalman:
            return self
        came = copy.deepcopy(other)
        came._state = came._state - np.array([log_unit, 0.0])
        came._contradicting.clear()  # in the other unit
        came._travelled = self._travelled
        came.widen(sigma)
        if self.is_open:
            return came
        first, last = sorted((copy.deepcopy(self), came), key=lambda known: known._time_s or 0.0)
        first.predict(last._time_s or 0.0, first._travelled)
        last._correct(_OF_X, first.log_scale - last.log_scale, first.sigma**2 + _LEAST_VARIANCE)
        last._spread = max(self._spread, came._spread, key=lambda spread: spread.weight)
        last._told_lost = max(self._told_lost, came._told_lost)
        last._contradicting, last.contested_sigma = copy.copy(self._contradicting), self.contested_sigma
        last.accepted = self.accepted + other.accepted
        last._support = self._support + other._support
        return last

    def update(self, observation: Observation) -> bool:
        """Takes in a keyframe's observation; False where it was refused as an outlier."""
        z = observation.log_scale
        variance = observation.point_variance + observation.excess_variance + _LEAST_VARIANCE
        if not (math.isfinite(z) and math.isfinite(variance) and abs(z) <= _MAX_LOG and variance >= 0.0):
            return False
        if not self._kalman:
            self._state = np.array([z, 0.0])
            self._covariance = np.diag([observation.variance, self._config.frame_sigma**2])
            self.accepted += 1
            return True
        innovation = z - float(self._state.sum())
        expected = float(self._covariance.sum()) + variance
        outlier = innovation**2 > self._config.gate_sigmas**2 * expected
        if outlier and not self._reopen(z, innovation, variance):
            return False
        self._contradicting.clear()
        self.contested_sigma = 0.0
        self._correct(_OF_BOTH, innovation, variance)
        self._spread.take(z - self.log_scale, self.learned_sigma, 1.0 - self.correlation(self._elapsed_s))
        self._elapsed_s = 0.0
        self.accepted += 1
        self._support += 1
        return True

    def _correct(self, sensitivity: Array, innovation: float, variance: float) -> None:
        """Take in a sum of the states that ``sensitivity`` (2,) has 1 at."""
        expected = float((self._covariance * np.outer(sensitivity, sensitivity)).sum()) + variance
        gain = self._covariance @ sensitivity / expected
        keep = np.eye(2) - np.outer(gain, sensitivity)
        self._state = self._state + gain * innovation
        # Joseph's form: stays symmetric and positive under rounding
        self._covariance = keep @ self._covariance @ keep.T + variance * np.outer(gain, gain)

    def _reopen(self, z: float, innovation: float, variance: float) -> bool:
        """Whether an outlier is the truth by now; x is then as open as the innovation is large."""
        self._contradicting.append(z)
        if not self.is_open:
            fewest, most = REOPEN_AFTER
            needed = min(max(self._support, fewest), most)
            agreed = self._config.gate_sigmas * math.sqrt(self._config.frame_sigma**2 + variance)
            agreeing = self._agreeing(min(needed, len(self._contradicting)), agreed)
            if len(agreeing) < needed:
                if len(agreeing):  # a stray one takes no doubt away
                    off = abs(float(np.median(agreeing)) - self.log_scale)
                    self.contested_sigma = off * len(agreeing) / needed
                return False
        self._covariance = self._covariance + np.diag([innovation**2 + self._config.initial_sigma**2, 0.0])
        self._support = 0
        self._spread = FrameSpread(max(self._thought, self._config.frame_sigma))
        return True

    def _agreeing(self, most: int, within: float) -> Array:
        """The latest observations refused in a row that agree, ``most`` of them; none where they are few."""
        for count in range(most, CONTESTED_AFTER - 1, -1):
            recent = np.array(self._contradicting)[-count:]
            if np.abs(recent - np.median(recent)).max() <= within:
                return recent
        return np.zeros(0)


def is_late(behind_s: float) -> bool:
    """Whether a keyframe so far behind the newest waited for its depth; else a clock has been set back."""
    return 0.0 < behind_s < _LATE_S


def _step(difference: float) -> float:
    """A difference that should be positive and finite, or 0."""
    return difference if math.isfinite(difference) and difference > 0.0 else 0.0
