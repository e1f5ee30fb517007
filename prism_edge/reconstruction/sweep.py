"""Depth held to the pictures: for each pixel, at which depth nearby do other keyframes show the same?

What the network's cross-view attention does in the paper (section 3.6), poses and pictures do here for a
network of any kind: depth is moved along each ray about what the network says, the surroundings of the pixel
are looked up in the keyframes beside it, and where they look alike (zero-mean normalised cross-correlation)
is its depth. Where a surface shows too little, it follows those round it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from prism_edge.geometry.poses import inverse
from prism_edge.reconstruction.look import F32, Look, surface

SPAN, STEPS = 0.2, 41  # of log depth to either side, and depths tried
WINDOW = 7  # pixels
LEAST_ALIKE, LEAST_APART = 0.6, 0.03  # correlation, and by how much it is above that of any other depth
MOST_OTHERS = 4  # keyframes asked, of which the two most alike count: from others it may be hidden
BASELINES = (0.03, 0.5)  # of the median depth
_OTHER_PEAK = 3  # steps away
_FLAT = 9.0  # variance of grey values below which there is nothing to compare
_NEAREST = 0.05  # m before a camera
_REACH, _FAR_REACH, _FAR_SHARE, _DAMPING = 12.0, 48.0, 0.1, 0.005  # pixels that a correction holds for


@dataclass(frozen=True)
class Correction:
    """By how much log depth is off (h, w), and where (h, w) the pictures say so."""

    log_depth: F32
    sure: NDArray[np.bool_]


def with_baseline(look: Look, beside: Sequence[Look]) -> list[Look]:
    """Of the keyframes beside one, those from which its depth shows, ``MOST_OTHERS`` at most."""
    depth = look.view.depth
    if not (depth > 0).any():
        return []
    far = float(np.median(depth[depth > 0]))
    here, (least, most) = look.view.world_from_camera[:3, 3], BASELINES
    baselines = (np.linalg.norm(other.view.world_from_camera[:3, 3] - here) / far for other in beside)
    return [o for o, baseline in zip(beside, baselines, strict=True) if least < baseline < most][:MOST_OTHERS]


def sweep(look: Look, others: Sequence[Look]) -> Correction:
    """The depth of each pixel by the pictures of ``others``, one at least."""
    steps = np.linspace(-SPAN, SPAN, STEPS, dtype=np.float32)
    mine = _Patches.of(look.grey.astype(np.float32))
    alike = _best_two(_alike(look, mine, other, steps) for other in others)
    best = alike.argmax(axis=0)
    rows, columns = np.indices(best.shape)
    inner = np.clip(best, 1, STEPS - 2)
    before, at, after = (alike[inner + i, rows, columns] for i in (-1, 0, 1))
    bend = np.minimum(before - 2.0 * at + after, -1e-6)
    between = np.clip(0.5 * (before - after) / bend, -1.0, 1.0)  # the peak of a parabola through the three
    apart = np.abs(np.arange(STEPS)[:, None, None] - best) > _OTHER_PEAK
    second = np.where(apart, alike, -2.0).max(axis=0)
    most = alike[best, rows, columns]
    sure = (most > LEAST_ALIKE) & (most - second > LEAST_APART) & (best == inner) & (look.view.depth > 0)
    return Correction((steps[inner] + between * (steps[1] - steps[0])).astype(np.float32), sure)


def corrected(look: Look, found: Correction) -> Look:
    """The look with its depths where the pictures have them; between, as those round a pixel are off."""
    weights = found.sure.astype(np.float32)
    said = found.log_depth * weights
    total, share = _DAMPING, np.float32(0.0)
    for reach, part in ((_REACH, 1.0), (_FAR_REACH, _FAR_SHARE)):
        share = share + part * cv2.GaussianBlur(said, (0, 0), reach)
        total = total + part * cv2.GaussianBlur(weights, (0, 0), reach)
    log_depth = np.where(found.sure, found.log_depth, share / total)
    return look.with_depth((look.view.depth * np.exp(log_depth)).astype(np.float32))


def _best_two(said: Iterable[F32]) -> F32:
    """The mean of the two largest at each place; one at a time, as a large picture's take gigabytes."""
    best = second = None
    for values in said:
        if best is None:
            best = values
        elif second is None:
            best, second = np.maximum(best, values), np.minimum(best, values)
        else:
            np.maximum(second, np.minimum(best, values), out=second)
            np.maximum(best, values, out=best)
    if best is None:
        raise ValueError("nobody was asked")
    return best if second is None else 0.5 * (best + second)


@dataclass(frozen=True)
class _Patches:
    """A picture's grey values (h, w) with mean and variance of the window round each."""

    grey: F32
    mean: F32
    variance: F32

    @classmethod
    def of(cls, grey: F32) -> _Patches:
        mean = _mean(grey)
        return cls(grey, mean, _mean(grey * grey) - mean * mean)


def _alike(look: Look, mine: _Patches, other: Look, steps: F32) -> F32:
    """Correlation (n, h, w) of the windows with what ``other`` shows there; -1 where it shows nothing."""
    view, camera = look.view, other.view.camera
    other_from_here = inverse(other.view.world_from_camera) @ view.world_from_camera
    turned = (surface(view) @ other_from_here[:3, :3].T).astype(np.float32)
    x, y, z = (np.ascontiguousarray(turned[..., i]) for i in range(3))
    dx, dy, dz = other_from_here[:3, 3].astype(np.float32)
    fx, fy, cx, cy = map(np.float32, (camera.fx, camera.fy, camera.cx, camera.cy))
    theirs = other.grey.astype(np.float32)
    found = np.empty((len(steps), *mine.grey.shape), np.float32)
    for i, factor in enumerate(np.exp(steps)):
        far = z * factor + dz
        before = far > _NEAREST
        far = np.where(before, far, np.float32(1.0))
        u, v = fx * (x * factor + dx) / far + cx, fy * (y * factor + dy) / far + cy
        seen = _Patches.of(cv2.remap(theirs, u, v, cv2.INTER_LINEAR))
        together = _mean(mine.grey * seen.grey) - mine.mean * seen.mean
        spread = np.maximum(mine.variance, 1.0) * np.maximum(seen.variance, 1.0)
        inside = before & (u >= WINDOW) & (v >= WINDOW) & (u <= camera.width - WINDOW)
        inside &= (v <= camera.height - WINDOW) & (mine.variance >= _FLAT)
        found[i] = np.where(inside, together / np.sqrt(spread), -1.0)
    return found


def _mean(values: F32) -> F32:
    return np.asarray(cv2.boxFilter(values, -1, (WINDOW, WINDOW), borderType=cv2.BORDER_REFLECT), np.float32)
