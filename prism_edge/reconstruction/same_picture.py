"""Whether a picture is the one that a keyframe was made from: stamps alone can be those of two recordings."""

from __future__ import annotations

import numpy as np

from prism_edge.tracking.features import Features
from prism_edge.tracking.matching import hamming

RADIUS = 3.0  # pixels; a rolling shutter's keypoints were moved, but hardly those of its middle rows
ALIKE = 40  # bits of 256 that may differ
LEAST_SHARE = 0.2  # of the picture's corners; how many were kept has changed since, and with it which
LEAST = 20  # corners, of fewer nothing can be told
_ROWS = 256  # corners at once


def is_picture_of(picture: Features, keyframe: Features) -> bool:
    """Whether a picture's corners are a keyframe's; True where there are too few to tell."""
    if min(len(picture), len(keyframe)) < LEAST:
        return True
    found = 0
    for first in range(0, len(picture), _ROWS):
        rows = slice(first, first + _ROWS)
        apart = picture.pixels[rows, None] - keyframe.pixels
        one, other = np.nonzero((apart**2).sum(axis=2) < RADIUS**2)
        alike = hamming(picture.descriptors[rows][one], keyframe.descriptors[other]) <= ALIKE
        found += len(np.unique(one[alike]))
    return found >= LEAST_SHARE * len(picture)
