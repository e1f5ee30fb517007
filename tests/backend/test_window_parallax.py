"""The widest angle between a point's rays, against angles that are known."""

from __future__ import annotations

import numpy as np
import pytest

from prism_edge.backend.window import widest_parallax
from tests.backend.world import chain
from tests.tracking.cloud import pose_at


def test_it_is_that_to_the_ray_farthest_from_the_first_and_no_other_two():
    """Of three views a right angle apart in turn the first and the second see the point under 90 degrees."""
    world = chain([pose_at(*centre) for centre in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.6, -0.8, 0.0))])
    for k in world.keyframes:
        world.observe(k, 0, 0)
    assert widest_parallax(world, {0: np.zeros(3)}) == pytest.approx({0: 90.0})
    among = widest_parallax(world, {0: np.zeros(3)}, {1, 2})
    assert among == pytest.approx({0: np.degrees(np.arccos(-0.8))})
    assert widest_parallax(world, {0: np.zeros(3)}, {2}) == pytest.approx({0: 0.0}, abs=1e-5)


def test_a_point_between_two_cameras_is_seen_from_opposite_sides():
    """Whatever rounding makes of it: a cosine beyond -1 has no angle."""
    rng = np.random.default_rng(0)
    for _ in range(8):
        one, other = rng.normal(size=(2, 3))
        world = chain([pose_at(*one), pose_at(*other)])
        shared = {p: one + t * (other - one) for p, t in zip(range(100, 110), rng.random(10), strict=True)}
        angles = np.array(list(widest_parallax(world, shared).values()))
        assert angles == pytest.approx(np.full(10, 180.0), abs=1e-4)
