"""What two solutions of one window cost, held against each other."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import pytest
from gtsam.symbol_shorthand import L

from prism_edge.backend import window as module
from prism_edge.backend.settling import costs_of
from prism_edge.backend.window import choose_window
from tests.backend.test_window import CONFIG, perturb, world_of
from tests.tracking.cloud import pose_at


def test_solutions_cost_the_same_whichever_is_asked_of_first() -> None:
    """Rays are whitened by the ranges of both: by its own alone a nearer one would cost too little."""
    world, _ = world_of([pose_at(0.2 * i, 0.02 * (i % 3)) for i in range(9)], noise_px=0.5)
    perturb(world, seed=3, pose_sigma=0.005, point_sigma=0.02)
    for point in world.points.values():
        point.parallax_deg = 1.0
    window = choose_window(world, 8, replace(CONFIG, window=5, fixed=4))
    problem = module.assemble(world, window, CONFIG, 1.0, use_depth=True, use_rays=True)
    assert problem.rays
    nearer = gtsam.Values(problem.values)
    for p in window.points:
        nearer.update(L(p), 0.3 * problem.values.atPoint3(L(p)))
    one, other = costs_of(world, problem, problem.values, nearer)
    assert costs_of(world, problem, nearer, problem.values) == pytest.approx((other, one))
    assert other > 1.1 * one > 0.0
