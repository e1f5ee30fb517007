"""Which observations a window gives up, beside those that its tests find by solving it."""

from __future__ import annotations

import numpy as np
import pytest

from prism_edge.backend.window import outliers
from prism_edge.config import BackendConfig
from prism_edge.geometry.poses import transform
from tests.backend.world import chain
from tests.tracking.cloud import CAMERA, pose_at


@pytest.mark.parametrize("unit", [0.01, 1.0, 100.0])
@pytest.mark.parametrize(("share", "wrong"), [(-1.0, True), (0.0015, True), (0.0025, False)])
def test_a_point_within_the_lens_is_wrong_though_its_pixel_fits_exactly(share, wrong, unit):
    """500 times nearer than the scene: any pose would have it behind the camera or far off its pixel."""
    here = pose_at(5.0 * unit, 0.0, 2.0 * unit, 0.0, 0.4)
    world = chain([here])
    keyframe, points = world.keyframes[0], {}
    for p, keypoint in keyframe.observed.items():
        local = np.array([[0.3, -0.2, 1.0]]) * unit * (3.0 * share if p == 7 else 3.0)
        points[p] = transform(here, local)[0]
        keyframe.pixels[keypoint] = CAMERA.to_pixels(local[:, :2] / local[:, 2:])[0]
    seen = [(0, p, keypoint) for p, keypoint in keyframe.observed.items()]
    found = outliers(world, {0: here}, points, seen, BackendConfig())
    assert found == ([(0, 7)] if wrong else [])
