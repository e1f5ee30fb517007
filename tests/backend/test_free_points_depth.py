"""How the depth of what a query sees goes with its motion, against the difference that a small one makes."""

from __future__ import annotations

import numpy as np
import pytest

from prism_edge.backend.free_points import _deepening
from prism_edge.geometry.poses import inverse, se3_exp, transform
from tests.tracking.cloud import pose_at


def mean_log_depth(pose: np.ndarray, places: np.ndarray) -> float:
    return float(np.log(transform(inverse(pose), places)[:, 2]).mean())


@pytest.mark.parametrize("follows", [False, True])
def test_the_mean_log_depth_goes_with_each_twist_as_it_says(follows: bool) -> None:
    rng = np.random.default_rng(0)
    pose = pose_at(0.5, -0.2, 0.1, 0.3, -0.4, 0.2)
    local = rng.uniform((0.5, -2.0, 2.0), (2.0, -0.5, 6.0), (40, 3))
    places = transform(pose, local)
    follow = rng.normal(0.0, 0.5, (40, 3, 6)) if follows else np.zeros((40, 3, 6))
    said = _deepening(pose, places, follow)
    step = 1e-6
    for axis, twist in enumerate(step * np.eye(6)):
        ahead = mean_log_depth(pose @ se3_exp(twist), places + follow @ twist)
        behind = mean_log_depth(pose @ se3_exp(-twist), places - follow @ twist)
        assert said[axis] == pytest.approx((ahead - behind) / (2 * step), abs=1e-6)
