"""A first map from a network that is at a loss: its second view puts it right."""

from __future__ import annotations

import numpy as np
import pytest

from prism_edge.geometry.poses import inverse, rotation_angle
from tests.tracking.film_run import Run
from tests.tracking.footage import IDENTITY, footage


def reversed_depth(depth: np.ndarray, power: float = 1.0) -> np.ndarray:
    """What is near is far, and the reverse."""
    middle = float(np.median(depth))
    return (middle * (middle / depth) ** power).astype(np.float32)


def slanted(depth: np.ndarray) -> np.ndarray:
    """A wall that recedes from left to right."""
    columns = np.median(depth) * np.exp(np.linspace(-1.0, 1.0, depth.shape[1]))
    return np.tile(columns, (depth.shape[0], 1)).astype(np.float32)


def until_the_second_keyframe(start: int, depth: np.ndarray) -> tuple[Run, int]:
    """The film from a frame on, with a depth for the first image alone; and the second keyframe's frame."""
    run = Run()
    run.feed(start, at=0)
    run.tracker.add_depth(0, depth, IDENTITY, 0.1)
    for i in range(1, 30):
        run.feed(start + i, at=i)
        if len(run.keyframes) == 2:
            return run, start + i
    raise AssertionError("there was no second keyframe")


@pytest.mark.parametrize(
    ("start", "wrong"),
    [
        (0, lambda depth: np.full_like(depth, np.median(depth))),
        (15, reversed_depth),
        (45, reversed_depth),
        (45, lambda depth: reversed_depth(depth, 2.0)),
        (45, slanted),
    ],
    ids=["flat", "reversed", "reversed, a turn", "twice so", "slanted"],
)
def test_matches_by_looks_alone_free_the_map_from_wrong_depths(start, wrong):
    """What tracking found at wrong depths agrees with the wrong motion they led to: a turn for a way."""
    film = footage()
    run, index = until_the_second_keyframe(start, wrong(film.depths[start]))
    found = run.tracker.world.newest().world_from_camera
    true = inverse(film.poses[start]) @ film.poses[index]
    assert rotation_angle(found[:3, :3].T @ true[:3, :3]) < np.radians(0.3)
    cosine = found[:3, 3] @ true[:3, 3] / np.linalg.norm(found[:3, 3]) / np.linalg.norm(true[:3, 3])
    assert np.degrees(np.arccos(cosine)) < 8.0
    world = run.tracker.world
    keypoints, depths = world.depths_in(world.newest())
    x, y = np.rint(world.newest().features.pixels[keypoints]).astype(int).T
    ratios = np.log(depths / film.depths[index][y, x])
    firm = world.points.parallax_deg[world.points.rows(world.newest().points[keypoints])] > 1.0
    assert firm.sum() >= 50
    assert np.median(np.abs(ratios[firm] - np.median(ratios[firm]))) < 0.1


def test_depths_that_agree_with_the_matches_stay():
    film = footage()
    run, index = until_the_second_keyframe(0, film.depths[0])
    error = run.tracker.world.newest().world_from_camera - film.poses[index]
    assert np.linalg.norm(error[:3, 3]) < 0.01
    first = run.tracker.world.keyframes[0]
    assert len(first.observed()) > 300, "what the network gave is still there"
