"""The paper's central claim on an assembled window: metric depth, nothing else, makes scale observable."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import L, X

from prism_edge.backend.global_map import GlobalMap
from prism_edge.backend.settling import with_rays
from prism_edge.backend.window import Window, assemble, choose_window, solve
from prism_edge.config import BackendConfig
from tests.backend.world import Teller, depth_at_keypoints
from tests.tracking.cloud import pose_at

POSES = [pose_at(0.15 * i, 0.03 * (i % 3), 0.02 * i, 0.0, -0.03 * i) for i in range(4)]
# Gaussian noise is what a Hessian describes: no robust kernel cuts it off, and no rounding stops a solve.
CONFIG = BackendConfig(
    observations=300, depth_sigma=0.08, huber_depth_m=10.0, huber_pixels=50.0, pixel_sigma=0.5, iterations=30
)


def world_of(count: int = 60, parallax_deg: float = 1.0) -> tuple[GlobalMap, Teller]:
    """A consistent world; points that rest on depth have rays, the others reprojections."""
    teller, world = Teller(count), GlobalMap()
    for pose in POSES:
        world.absorb(teller.keyframe(pose))
    for k, pose in enumerate(POSES):
        world.keyframes[k].world_from_camera = pose.copy()
    for p, point in world.points.items():
        point.position = teller.cloud.positions[p].copy()
        point.parallax_deg = parallax_deg if p % 2 else 10.0
    depth_at_keypoints(world, teller.cloud, POSES)
    return world, teller


def window_of(world: GlobalMap) -> Window:
    window = choose_window(world, len(POSES) - 1, CONFIG)
    assert len(window.held) == 1, "the claim is about exactly one fixed pose"
    return window


def information(
    world: GlobalMap, window: Window, use_depth: bool, use_rays: bool = True
) -> tuple[np.ndarray, np.ndarray]:
    """Hessian of what is free, and the direction in it along which log scale grows by one."""
    problem = assemble(world, window, CONFIG, 1.0, use_depth, use_rays)
    graph = with_rays(world, problem, problem.values)
    ordering, direction = gtsam.Ordering(), []
    for k in window.free:
        pose = world.keyframes[k].world_from_camera
        ordering.push_back(X(k))
        direction += [0.0, 0.0, 0.0, *(pose[:3, :3].T @ pose[:3, 3])]
    for p in window.points:
        ordering.push_back(L(p))
        direction += world.points[p].position.tolist()
    for k in window.held:
        ordering.push_back(X(k))
    hessian = graph.linearize(problem.values).hessian(ordering)[0]
    free = len(direction)
    # The held pose is the origin, so scaling about it leaves it where it is.
    assert np.allclose(world.keyframes[window.held[0]].world_from_camera, np.eye(4))
    return hessian[:free, :free], np.array(direction)


def scaled_to_unit_diagonal(hessian: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    root = np.sqrt(np.diag(hessian))
    along = direction * root
    return hessian / np.outer(root, root), along / np.linalg.norm(along)


@pytest.mark.parametrize("parallax_deg", [1.0, 10.0])
def test_without_metric_factors_the_weakest_direction_is_scale(parallax_deg):
    world, _ = world_of(parallax_deg=parallax_deg)
    hessian, along = scaled_to_unit_diagonal(*information(world, window_of(world), False))
    values, vectors = np.linalg.eigh(hessian)
    assert abs(values[0]) < 1e-9
    assert values[1] > 1e4 * abs(values[0])
    assert abs(vectors[:, 0] @ along) > 0.999


@pytest.mark.parametrize("parallax_deg", [1.0, 10.0])
def test_with_metric_factors_no_direction_is_free(parallax_deg):
    """With rays in place of half of the reprojections (shallow points), and with reprojections alone."""
    world, _ = world_of(parallax_deg=parallax_deg)
    hessian, along = scaled_to_unit_diagonal(*information(world, window_of(world), True))
    assert np.linalg.eigvalsh(hessian)[0] > 1e-6
    assert along @ hessian @ along > 1e-5


def test_two_fixed_poses_would_have_proved_nothing():
    world, _ = world_of()
    window = window_of(world)
    two = Window(window.free[1:], [*window.held, window.free[0]], window.points)
    problem = assemble(world, two, CONFIG, 1.0, use_depth=False, use_rays=True)
    hessian = problem.graph.linearize(problem.values).hessian()[0]
    root = np.sqrt(np.diag(hessian))
    assert np.linalg.eigvalsh(hessian / np.outer(root, root))[0] > 1e-7


def log_scale_of(world: GlobalMap, points: dict[int, np.ndarray]) -> float:
    """Of a solution against the world's true places, by the points' projection on these."""
    truth = np.array([world.points[p].position for p in points])
    return float(np.log(np.sum(truth * np.array(list(points.values()))) / np.sum(truth * truth)))


def test_the_sigma_of_log_scale_is_what_repeating_the_experiment_shows():
    """From the window's Hessian against 250 solves with fresh pixel and depth noise, within 15 %."""
    world, _ = world_of(40)
    window = window_of(world)
    places = np.concatenate([world.points[p].position for p in window.points])
    pick = np.r_[np.zeros(6 * len(window.free)), places / (places @ places)]
    # Noise is drawn of pixels, so reprojections carry it: a ray is as wide in metres as it is made.
    hessian, _ = information(world, window, True, use_rays=False)
    predicted = float(np.sqrt(pick @ np.linalg.solve(hessian, pick)))
    rng = np.random.default_rng(0)
    clean = {k: (f.pixels.copy(), f.depths.copy()) for k, f in world.keyframes.items()}
    found = []
    for _ in range(250):
        for k, keyframe in world.keyframes.items():
            pixels, depths = clean[k]
            noise = CONFIG.pixel_sigma * keyframe.sigmas[:, None] * rng.normal(0, 1, pixels.shape)
            keyframe.pixels = pixels + noise
            keyframe.depths = depths * (1 + CONFIG.depth_sigma * rng.normal(0, 1, depths.shape))
        solution = solve(world, window, CONFIG, 1.0, use_depth=True, use_rays=False)
        found.append(log_scale_of(world, solution.points))
    assert predicted == pytest.approx(float(np.std(found)), rel=0.15)
