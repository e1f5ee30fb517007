"""Whether a picture is the one that a keyframe was made from: stamps alone can be those of two recordings."""

from __future__ import annotations

import numpy as np

from prism_edge.geometry.poses import Array
from prism_edge.tracking.features import Features
from prism_edge.tracking.matching import candidate_pairs, hamming

RADIUS = 3.0  # pixels
MOVED = 20.0  # pixels: as far may a rolling shutter's keypoints have been moved, the first and last rows'
ALIKE = 40  # bits of 256 that may differ
LEAST_SHARE = 0.25  # of the fewer corners: own pictures have 0.3 and more, others seldom 0.2
LEAST = 20  # corners, of fewer nothing can be told


def is_picture_of(picture: Features, keyframe: Features, height: int) -> bool:
    """Whether a picture's corners are a keyframe's; True where there are too few to tell.

    The keyframe's may have been moved for a rolling shutter: by the more, the farther they are from the
    middle row of ``height``.
    """
    if min(len(picture), len(keyframe)) < LEAST:
        return True
    one, other = candidate_pairs(keyframe, picture.pixels, np.full(len(picture), MOVED))
    alike = hamming(picture.descriptors[one], keyframe.descriptors[other]) <= ALIKE
    one, other = one[alike], other[alike]
    apart = keyframe.pixels[other] - picture.pixels[one]
    apart -= _sheared(apart, picture.pixels[one, 1] - (height - 1) / 2, height)
    same = np.einsum("ij,ij->i", apart, apart) < RADIUS**2
    # A run may have kept a few of the corners that we find here, or more of them.
    found = min(len(np.unique(one[same])), len(np.unique(other[same])))
    return found >= LEAST_SHARE * min(len(picture), len(keyframe))


def _sheared(apart: Array, below: Array, height: int) -> Array:
    """How far (n, 2) rows (n,) below the middle were moved, as most above it and most below say.

    Another picture is moved sideways: the halves say the opposite of each other, and nothing is left of it.
    """
    halves = below > height / 8, below < -height / 8
    if min(half.sum() for half in halves) < LEAST:
        return np.zeros_like(apart)
    said = [np.median(apart[half] / below[half, None], axis=0) for half in halves]
    moved: Array = below[:, None] * np.mean(said, axis=0)
    return moved
