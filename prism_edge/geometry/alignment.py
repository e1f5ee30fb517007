"""Least-squares alignment of two point sets by a rigid motion or a similarity; pure numpy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from prism_edge.geometry.poses import Array


class DegenerateAlignment(ValueError):  # noqa: N818 - names the situation, as LinAlgError does not
    """The points don't determine an alignment."""


@dataclass(frozen=True)
class Alignment:
    """``target ~ scale * rotation @ source + translation``."""

    rotation: Array  # (3, 3)
    translation: Array  # (3,)
    scale: float

    def apply(self, points: Array) -> Array:
        """Points (n, 3) of the source's frame in the target's."""
        return self.scale * points @ self.rotation.T + self.translation


def align(source: Array, target: Array, with_scale: bool, weights: Array | None = None) -> Alignment:
    """The rigid motion (``with_scale`` False) or similarity that carries ``source`` onto ``target``.

    Both are (n, 3), row i of one belonging to row i of the other, n >= 3. Minimises the sum of squared
    distances, each times its row's share of ``weights`` (n,), in closed form (Umeyama, IEEE PAMI 13(4),
    1991, equations 34-43). Where all points lie on a line, the rotation about it is arbitrary, but the
    residuals are still the least ones.

    Raises ValueError where shapes differ, and DegenerateAlignment where there are fewer than 3 points,
    a coordinate isn't finite, or all points of one set coincide.
    """
    source, target = np.asarray(source, dtype=np.float64), np.asarray(target, dtype=np.float64)
    if source.shape != target.shape or source.ndim != 2 or source.shape[1] != 3:
        raise ValueError(f"point sets must both be (n, 3), not {source.shape} and {target.shape}")
    if len(source) < 3:
        raise DegenerateAlignment(f"an alignment needs at least 3 points, not {len(source)}")
    if not (np.isfinite(source).all() and np.isfinite(target).all()):
        raise DegenerateAlignment("points to align must be finite")
    share = np.full(len(source), 1.0 / len(source)) if weights is None else weights / weights.sum()
    source_mean, target_mean = share @ source, share @ target
    source_centred, target_centred = source - source_mean, target - target_mean
    source_variance = float(share @ (source_centred**2).sum(axis=1))
    for centred, mean in ((source_centred, source_mean), (target_centred, target_mean)):
        # Points closer together than rounding of their own coordinates have no direction.
        if np.abs(centred).max() <= 1e-12 * max(1.0, float(np.abs(mean).max())):
            raise DegenerateAlignment("all points coincide: they determine no rotation")
    covariance = (target_centred.T * share) @ source_centred
    u, singular, vt = np.linalg.svd(covariance)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])  # never a reflection
    rotation = (u * signs) @ vt
    scale = float(singular @ signs) / source_variance if with_scale else 1.0
    return Alignment(rotation, target_mean - scale * rotation @ source_mean, scale)
