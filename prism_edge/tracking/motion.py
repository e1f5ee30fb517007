"""Where the camera will be, and how surely: it goes on as it went, but for how it may have speeded up.

A Kalman filter on the camera's pose and twist, with white noise for its acceleration. Where a frame shows
much, the prediction only says where to look. Where it shows little, as before a person who hides all but a
strip of the scene, what is left fixes some directions by centimetres, and there the prediction knows better:
so a pose is solved with it as with one measurement more. It has Cauchy's cost, for a camera may be pushed:
what is farther from the frame's points than both could err lets go.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from prism_edge.geometry.poses import Array, adjoint, inverse, se3_exp, se3_log
from prism_edge.tracking.pace import Pace

LONGEST_S = 0.6  # between two frames that still say how fast the camera is
CHI2_6D_999 = 22.46
LETS_GO = 4.0  # sigmas beyond which a prediction counts for less the farther it is
# Density of the acceleration's noise, translation and rotation: a share of the depth's square (1/s^3), and
# rad^2/s^3. At the least so much: a robot that seems to stand may start, and would outrun its prediction.
FIRST, LEAST = np.repeat((0.25, 10.0), 3), np.repeat((0.01, 0.3), 3)
LEARNED_S, MOST_AT_ONCE = 0.3, 8.0  # how fast it is learned; times what was expected that one frame counts
UNKNOWN = 1.0  # variance, squared map units and radians, beyond which a pose says nothing of the motion
_TRANSLATION, _ROTATION = slice(0, 3), slice(3, 6)


@dataclass(frozen=True)
class Prediction:
    """A pose that is expected, and how surely."""

    world_from_camera: Array  # (4, 4)
    information: Array  # (6, 6): translation first, camera frame

    @cached_property
    def _camera_from_world(self) -> Array:
        return inverse(self.world_from_camera)

    def carried(self, motion: Array) -> Prediction:
        """The same in a world that was moved by ``motion`` (4, 4), a rigid one."""
        return Prediction(motion @ self.world_from_camera, self.information)

    def rules_out(self, pose: Array) -> bool:
        """Whether the camera can't be at a pose, 999 times in a thousand."""
        off = se3_log(self._camera_from_world @ pose)
        return float(off @ self.information @ off) > CHI2_6D_999

    def pull(self, pose: Array) -> tuple[float, Array, Array]:
        """What it has against a pose: cost, and by the pose's right-hand twist information and gradient."""
        off = se3_log(self._camera_from_world @ pose)
        gradient = self.information @ off
        beyond = 1.0 + float(off @ gradient) / LETS_GO**2
        return LETS_GO**2 * float(np.log(beyond)), self.information / beyond, gradient / beyond


class ConstantVelocity:
    """A twist of the camera, in its own frame, per second; zero where nothing is known of it."""

    def __init__(self) -> None:
        self.stamp_ns = 0  # of the last frame
        self.least_s = 0.0  # between two frames: images stamped by arrival may come together
        self.pace = Pace()
        self.twist = np.zeros(6)
        self._joint: Array | None = None  # (12, 12), covariance of pose and twist; None: not known
        self._density, self._unit = FIRST.copy(), np.ones(6)  # of which it is a share
        self._ahead: tuple[Prediction, Array] | None = None  # the last, and the joint covariance

    def saw(self, index: int, stamp_ns: int, least_s: float) -> None:
        """An image has come; two are ``least_s`` apart at least, which may be wrongly said."""
        self.pace.see(index, stamp_ns)
        self.least_s = min(least_s, self.pace.usual_s or least_s)

    def stop(self) -> None:
        """What was known of the motion is not to be trusted."""
        self.twist, self._joint = np.zeros(6), None

    def predict(self, world_from_camera: Array, stamp_ns: int) -> Array:
        """Pose (4, 4) at a time, of a camera that was at a pose when the last frame was taken."""
        elapsed_s = self._elapsed_s(stamp_ns)
        if elapsed_s >= LONGEST_S:
            return world_from_camera.copy()
        moved: Array = world_from_camera @ se3_exp(self.twist * elapsed_s)
        return moved

    def expect(self, world_from_camera: Array, stamp_ns: int, depth: float) -> Prediction | None:
        """:meth:`predict` and how sure that is; None where that isn't known.

        ``depth`` is what most of the scene is away, map units: a camera before a far scene may be a fast one.
        """
        elapsed_s = self._elapsed_s(stamp_ns)
        self._ahead = None
        if self._joint is None or not 0 < elapsed_s < LONGEST_S:
            return None
        self._unit[_TRANSLATION] = depth * depth if 0.0 < depth < np.inf else 1.0
        density = self._density * self._unit
        step = np.eye(12)
        step[:6, :6] = adjoint(se3_exp(self.twist * -elapsed_s))
        step[:6, 6:].flat[::7] = elapsed_s
        joint = step @ self._joint @ step.T
        joint.flat[: 6 * 12 : 13] += density * (elapsed_s**3 / 3.0)
        joint.flat[6 : 6 * 12 : 13] += density * (elapsed_s**2 / 2.0)
        joint.flat[6 * 12 :: 13] += density * (elapsed_s**2 / 2.0)
        joint.flat[6 * 13 :: 13] += density * elapsed_s
        information = np.asarray(np.linalg.inv(joint[:6, :6]), np.float64)
        expected = Prediction(self.predict(world_from_camera, stamp_ns), information)
        self._ahead = expected, joint
        return expected

    def follow(
        self,
        before: Array | None,
        after: Array,
        stamp_ns: int,
        covariance: Array | None = None,
        expected: Prediction | None = None,
    ) -> None:
        """A frame is placed at ``after``; ``before`` is where the same map has the one before it.

        ``covariance`` (6, 6) is what its points alone say of the pose, ``expected`` what :meth:`expect` gave
        where the pose was solved with that, too.
        """
        ahead, self._ahead = self._ahead, None
        elapsed_s = self._elapsed_s(stamp_ns)
        if covariance is None or ahead is None or ahead[0] is not expected:
            self.twist = self.since(before, after, stamp_ns)
            self._joint = self._begun(covariance, elapsed_s) if self.twist.any() else None
        else:
            self._correct(*ahead, after, covariance, elapsed_s)
        self.stamp_ns = stamp_ns

    def since(self, before: Array | None, after: Array, stamp_ns: int) -> Array:
        """The twist (6,) from the last frame to one at ``after``; zero where the two tell nothing of it."""
        elapsed_s = self._elapsed_s(stamp_ns)
        if before is None or not 0 < elapsed_s < LONGEST_S:
            return np.zeros(6)
        return se3_log(inverse(before) @ after) / elapsed_s

    def _elapsed_s(self, stamp_ns: int) -> float:
        elapsed_s = (stamp_ns - self.stamp_ns) * 1e-9
        if elapsed_s > 0.0 and self.pace.step_s and self.stamp_ns == self.pace.since_ns:
            elapsed_s = self.pace.step_s
        return max(elapsed_s, self.least_s) if elapsed_s > 0.0 else elapsed_s

    def _begun(self, covariance: Array | None, elapsed_s: float) -> Array | None:
        """Of a twist that is the difference of two poses, as doubtful the one as the other, at its end."""
        if covariance is None or not np.trace(covariance) < UNKNOWN:
            return None
        joint = np.zeros((12, 12))
        joint[:6, :6] = covariance
        joint[:6, 6:] = joint[6:, :6] = covariance / elapsed_s
        changed = self._density * self._unit * (elapsed_s / 3.0)  # since then, against the mean
        joint[6:, 6:] = covariance * (2.0 / elapsed_s**2) + np.diag(changed)
        return joint

    def _correct(
        self, expected: Prediction, joint: Array, after: Array, covariance: Array, elapsed_s: float
    ) -> None:
        """The filter's update from its result: the pose that points and prediction came to together."""
        shift = se3_log(inverse(expected.world_from_camera) @ after)
        prior = joint[:6, :6]
        told = prior @ np.linalg.solve(prior + covariance, prior)  # the covariance of such shifts
        gain = joint[:, :6] @ expected.information
        self.twist = self.twist + gain[6:] @ shift
        joint = joint - gain @ told @ gain.T
        self._joint = 0.5 * (joint + joint.T)
        for axes in (_TRANSLATION, _ROTATION):
            usual = np.trace(told[axes, axes])
            times = min(float(shift[axes] @ shift[axes]) / max(usual, 1e-12), MOST_AT_ONCE)
            share = usual / np.trace(prior[axes, axes])  # of a prediction's doubt that this frame ends
            self._density[axes] *= np.exp(share * min(elapsed_s / LEARNED_S, 1.0) * (times - 1.0))
        self._density = np.maximum(self._density, LEAST)
