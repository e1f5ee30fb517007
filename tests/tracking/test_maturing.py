"""Points that two views place: only where both views' pixels agree with the place."""

from __future__ import annotations

import numpy as np
import pytest

from prism_edge.tracking import mapping
from prism_edge.tracking.features import Features
from prism_edge.tracking.local_map import LocalKeyframe
from tests.tracking.cloud import CAMERA, FACTORS, Cloud, pose_at
from tests.tracking.test_mapping import add, seeded

COARSEST = len(FACTORS) - 1


def at_level(keyframe: LocalKeyframe, keypoints: np.ndarray, level: int, aside_px: float) -> None:
    """These keypoints on another pyramid level, and so many pixels farther down."""
    features = keyframe.features
    pixels, octaves = features.pixels.copy(), features.octaves.copy()
    pixels[keypoints, 1] += aside_px
    octaves[keypoints] = level
    keyframe.features = Features.build(
        pixels, octaves, features.descriptors, CAMERA.width, CAMERA.height
    )


@pytest.mark.parametrize(("first_level", "level"), [(0, COARSEST), (COARSEST, 0)])
def test_a_point_that_does_not_fit_the_finer_of_its_two_pixels_keeps_its_place(
    first_level: int, level: int
) -> None:
    """A wrong match beside the epipolar line: one of a coarse level may be as far off, a fine one not."""
    cloud = Cloud(500, seed=1)
    world, shown = seeded(cloud, every=2, wrong=1.15)
    keyframe, _ = add(world, cloud, shown, 1, pose_at(0.4))
    keypoints = keyframe.observed()[:20]
    rows = world.points.rows(keyframe.points[keypoints])
    at_level(world.keyframes[0], world.points.reference_keypoint[rows], first_level, 0.0)
    at_level(keyframe, keypoints, level, 10.0)
    before = world.points.position[rows].copy()
    assert mapping.mature(world, keyframe, FACTORS) > 50
    assert np.array_equal(world.points.position[rows], before)
    assert not world.points.parallax_deg[rows].any()
    at_level(keyframe, keypoints, level, -10.0)
    assert mapping.mature(world, keyframe, FACTORS) >= 15, "nothing else was wrong with them"
