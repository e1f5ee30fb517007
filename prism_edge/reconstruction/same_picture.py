"""Whether a picture is the one that a keyframe was made from: stamps alone can be those of two recordings."""

from __future__ import annotations

import numpy as np

from prism_edge.tracking.features import Features
from prism_edge.tracking.matching import candidate_pairs, hamming

RADIUS = 15.0  # pixels: keypoints of a rolling shutter were moved, in a fast turn by ten and more
ALIKE = 40  # bits of 256 that may differ
LEAST_SHARE = 0.4  # of the fewer corners: own pictures have 0.9, one beside it 0.26, other places 0.01
LEAST = 20  # corners, of fewer nothing can be told


def is_picture_of(picture: Features, keyframe: Features) -> bool:
    """Whether a picture's corners are a keyframe's; True where there are too few to tell."""
    if min(len(picture), len(keyframe)) < LEAST:
        return True
    one, other = candidate_pairs(keyframe, picture.pixels, np.full(len(picture), RADIUS))
    apart = picture.pixels[one] - keyframe.pixels[other]
    alike = hamming(picture.descriptors[one], keyframe.descriptors[other]) <= ALIKE
    alike &= np.einsum("ij,ij->i", apart, apart) < RADIUS**2
    # A run may have kept a few of the corners that we find here, or more of them.
    found = min(len(np.unique(one[alike])), len(np.unique(other[alike])))
    return found >= LEAST_SHARE * min(len(picture), len(keyframe))
