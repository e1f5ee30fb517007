"""A place mapped from close by and seen again from aside, in clouds whose true poses are known."""

from __future__ import annotations

import numpy as np

from prism_edge.backend.global_map import GlobalKeyframe, GlobalMap
from prism_edge.geometry.poses import Array, inverse, transform
from prism_edge.tracking.pose_refinement import refine_pose
from tests.backend.world import Teller
from tests.tracking.cloud import pose_at

Pairs = list[tuple[int, int]]
NOISE_PX = 0.5
CANDIDATES = [pose_at(0.04 * i) for i in range(3)]  # of hardly any parallax
QUERY = pose_at(0.5, 0.3)


def seen_again(seed: int = 0, views: int = 3) -> tuple[GlobalMap, GlobalKeyframe, Pairs]:
    """The map, and a query at :data:`QUERY` that sees the place anew and has told of none of its points.

    Each of these is seen by so many other ``views``.
    """
    teller, world = Teller(120, seed=seed, noise_px=NOISE_PX), GlobalMap()
    for pose in [*CANDIDATES, QUERY]:
        world.absorb(teller.keyframe(pose))
    query = world.keyframes[3]
    pairs = [(i, p) for p, i in query.observed.items() if len(world.points[p].keyframes) > 1]
    for _, p in pairs:
        world.points[p].keyframes.discard(query.id)
        for k in sorted(world.points[p].keyframes)[views:]:
            world.points[p].keyframes.discard(k)
            world.keyframes[k].observed.pop(p)
    query.observed.clear()
    assert len(pairs) >= 30
    return world, query, pairs


def off_along_rays(world: GlobalMap, pairs: Pairs, slope: float) -> None:
    """Depths wrong by a share that grows from one side of the image to the other."""
    here = world.keyframes[0].world_from_camera
    for _, p in pairs:
        local = transform(inverse(here), world.points[p].position[None])[0]
        factor = 1.0 + slope * local[0] / local[2]
        world.points[p].position = transform(here, factor * local[None])[0]


def pose_by_points(world: GlobalMap, query: GlobalKeyframe, pairs: Pairs) -> Array:
    """world_from_query as its points have it, taken for exact."""
    pixels, sigmas = (of[[i for i, _ in pairs]] for of in (query.pixels, query.sigmas))
    points = np.array([world.points[p].position for _, p in pairs])
    return refine_pose(query.camera, QUERY, points, pixels, sigmas).world_from_camera
