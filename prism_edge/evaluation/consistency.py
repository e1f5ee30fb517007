"""Whether published covariances are as large as the errors that they speak of; pure (docs/EVALUATION.md).

An error whose covariance is right has, on average, a normalised square (NEES) of 1 a degree of freedom.
"""

from __future__ import annotations

import math
from collections.abc import Container
from dataclasses import dataclass

import numpy as np

from prism_edge.evaluation.recording import Published, Recording
from prism_edge.evaluation.trajectory import NS, Trajectory, paired, rows_apart
from prism_edge.geometry.poses import Array, adjoint, inverse, se3_log, so3_log, swung
from prism_edge.messages import Tracked

_FLOOR = 1e-12  # m^2, rad^2: below what is published, so that an exact direction doesn't divide by 0


@dataclass(frozen=True)
class Nees:
    """Average NEES a degree of freedom of relative poses; None where there is no pair."""

    pairs: int
    all: float | None
    translation: float | None
    rotation: float | None


NO_NEES = Nees(0, None, None, None)


def relative_nees(
    recording: Recording, truth: Trajectory, base_from_camera: Array, delta_s: float = 1.0
) -> Nees:
    """NEES of the motion between published poses ``delta_s`` apart (`rows_apart`).

    Of what a published covariance consists of, two poses share the error of scale, which moves a
    pose by its distance from the start, and the drift since the map's beginning, a random walk; `tracked`
    has both for each frame. So the motion between i and j has: what is left of i and of j without those two,
    independent of one another; what the walk of `odom` grew by between them, or, across a loop, the drift
    that it has taken out; and the scale's share of the motion itself. ``truth`` is world_from_camera.
    """
    shared = {
        f.stamp_ns: (f.scale_sigma, f.drift_m, f.drift_rad, f.walk_m, f.walk_rad) for f in recording.frames
    }
    poses = sorted(recording.published.values(), key=lambda pose: pose.stamp_ns)
    poses = [p for p in poses if p.stamp_ns in shared and _finite(p)]
    if len(poses) < 2 or not len(truth):
        return NO_NEES
    estimate = Trajectory.of((p.stamp_ns, p.map_from_camera) for p in poses)
    covariances = {p.stamp_ns: p.covariance for p in poses}
    estimate, truth = paired(estimate, truth)
    stamps = estimate.stamps
    starts, ends = rows_apart(stamps, delta_s)
    if not len(starts):
        return NO_NEES
    camera_from_base = inverse(base_from_camera)
    sigmas, drift_m, drift_rad, walk_m, walk_rad = np.array([shared[int(s)] for s in stamps]).T
    sums = np.zeros(3)
    for i, j in zip(starts, ends, strict=True):
        own = []
        for k in (i, j):
            covariance = covariances[int(stamps[k])]
            assert covariance is not None
            start = estimate.poses[k][:3, 3] - base_from_camera[:3, 3]
            base = estimate.poses[k] @ camera_from_base
            arm = base[:3, 3] - estimate.poses[k][:3, 3]
            drift = swung(_walk(drift_m[k] ** 2, drift_rad[k] ** 2), arm)
            own.append(_own(covariance, base, start, sigmas[k], drift))
        moved = base_from_camera @ inverse(estimate.poses[i]) @ estimate.poses[j] @ camera_from_base
        true = base_from_camera @ inverse(truth.poses[i]) @ truth.poses[j] @ camera_from_base
        carry = adjoint(inverse(moved))
        covariance = own[1] + carry @ own[0] @ carry.T
        grown = _walk(_grown(walk_m, drift_m, i, j), _grown(walk_rad, drift_rad, i, j))
        covariance += swung(grown, -base_from_camera[:3, 3]) + _FLOOR * np.eye(6)
        # Only the camera's path is scaled: where it sits on the robot is known in metres.
        path = estimate.poses[j][:3, 3] - estimate.poses[i][:3, 3]
        along = (estimate.poses[j] @ camera_from_base)[:3, :3].T @ path
        covariance[:3, :3] += sigmas[j] ** 2 * np.outer(along, along)
        error = se3_log(inverse(true) @ moved)
        sums += _squares(error, covariance)
    return Nees(len(starts), *(sums / len(starts)).tolist())


def pose_nees(recording: Recording, truth: Trajectory, base_from_camera: Array) -> Nees:
    """NEES of each published pose by itself, in `map`: of its whole way since the map's beginning.

    `map` is where ``base_link`` was at the map's first keyframe, which the first pose refers to; so the true
    pose is what ``truth`` (world_from_camera) moved since that keyframe. Its first second is left out, in
    which poses rest on one depth image. None where the first keyframe has no true pose.
    """
    poses = {p.stamp_ns: p for p in recording.published.values() if _finite(p)}
    began = _first_keyframe(recording.frames, poses)
    if began is None:
        return NO_NEES
    start, there = paired(Trajectory.of([(began.stamp_ns, np.eye(4))]), truth)
    later = [(s, p.map_from_camera) for s, p in sorted(poses.items()) if s >= began.stamp_ns + NS]
    estimate, truth = paired(Trajectory.of(later), truth)
    if not len(start) or not len(estimate):
        return NO_NEES
    camera_from_base = inverse(base_from_camera)
    map_from_world = inverse(there.poses[0] @ camera_from_base)
    sums = np.zeros(3)
    for stamp, pose, world_from_camera in zip(estimate.stamps, estimate.poses, truth.poses, strict=True):
        covariance = poses[int(stamp)].covariance
        assert covariance is not None
        found, true = pose @ camera_from_base, map_from_world @ world_from_camera @ camera_from_base
        error = np.concatenate([(found - true)[:3, 3], so3_log(found[:3, :3] @ true[:3, :3].T)])
        sums += _squares(error, covariance + _FLOOR * np.eye(6))
    return Nees(len(estimate), *(sums / len(estimate)).tolist())


def _first_keyframe(frames: list[Tracked], poses: Container[int]) -> Tracked | None:
    """The frame that began the map that the first published pose is in."""
    first = next((f for f in frames if f.stamp_ns in poses), None)
    if first is None:
        return None
    return next((f for f in frames if f.keyframe == first.reference), None)


def scale_errors(
    scale_ratio: float | None, sigma: float | None, bias_sigma: float | None
) -> tuple[float | None, float | None]:
    """(|log scale_ratio| / sigma, sigma / the network's bias sigma) of the last `scale`; None: unknown.

    ``scale_ratio`` is true / estimated; ``bias_sigma`` is what the network's card says.
    """
    if sigma is None or not sigma > 0.0:
        return None, None
    known = scale_ratio is not None and scale_ratio > 0.0
    error = abs(math.log(scale_ratio)) / sigma if known and scale_ratio is not None else None
    return error, sigma / bias_sigma if bias_sigma is not None and bias_sigma > 0.0 else None


def _grown(walk: Array, drift: Array, i: np.intp, j: np.intp) -> float:
    """Variance that drift puts between two poses: what was walked, or what a loop took out."""
    return float(max(abs(walk[j] ** 2 - walk[i] ** 2), drift[i] ** 2 - drift[j] ** 2))


def _walk(metres2: float, radians2: float) -> Array:
    return np.diag([metres2] * 3 + [radians2] * 3)


def _own(covariance: Array, base: Array, start: Array, sigma: float, drift: Array) -> Array:
    """A published covariance without scale and drift (6, 6), in the base's own axes."""
    left = covariance - drift
    left[:3, :3] -= sigma**2 * np.outer(start, start)
    turn = np.kron(np.eye(2), base[:3, :3].T)
    own: Array = turn @ left @ turn.T
    return own


def _squares(error: Array, covariance: Array) -> Array:
    """Normalised squares (3,) of an error (6,), a degree of freedom: of all, translation, rotation."""
    parts = [(error[part], covariance[part, part]) for part in (slice(0, 6), slice(0, 3), slice(3, 6))]
    return np.array([float(e @ np.linalg.solve(of, e)) / len(e) for e, of in parts])


def _finite(pose: Published) -> bool:
    covariance = pose.covariance
    known = covariance is not None and bool(np.isfinite(covariance).all())
    return known and bool(np.isfinite(pose.map_from_camera).all())
