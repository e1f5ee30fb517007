"""The tracker's map made from the backend's: for a tracker started again, or a map that was loaded."""

from __future__ import annotations

import numpy as np

from prism_edge.backend.global_map import LONG_AGO, GlobalKeyframe, GlobalMap
from prism_edge.geometry.poses import Array
from prism_edge.tracking.local_map import LEAST_SHARED, NO_POINT, LocalKeyframe, LocalMap
from prism_edge.tracking.mapping import depth_sigma
from prism_edge.tracking.point_table import Ids

NEIGHBOURS = 20
SEEDED_SIGMA = 0.2  # relative depth error of a point that was never triangulated


def local_copy(world: GlobalMap) -> LocalMap:
    """Keyframes, points and who sees what, with the backend's numbers; nothing of it is news to the backend.

    What the backend does not keep is put as cautiously as need be: points count as seen in as many frames
    as there are keyframes that see them; they were made long ago, and keyframes' stamps are 0.
    """
    copy = LocalMap(world.readout_ms)
    order = sorted(world.keyframes)
    ids = np.array(sorted(p for p, point in world.points.items() if point.keyframes), np.int64)
    if len(ids):
        positions, parallax = _columns(world, ids)
        first = [_reference(world, p) for p in ids.tolist()]
        focal = np.array([world.keyframes[k].camera.fx for k in first])
        angle = np.radians(parallax)
        with np.errstate(divide="ignore"):
            sigma = np.where(angle > 0.0, depth_sigma(focal, angle), SEEDED_SIGMA)
        copy.points.restore(
            ids,
            position=positions,
            parallax_deg=parallax,
            log_depth_sigma=np.minimum(sigma, SEEDED_SIGMA),
            reference=first,
            reference_keypoint=[
                world.keyframes[k].observed[p] for k, p in zip(first, ids.tolist(), strict=True)
            ],
            observations=0,
            born_ns=LONG_AGO,
        )
    near = _neighbours(world, order, ids)
    # In their order, so that points look as the newest keyframe saw them.
    for k in order:
        copy.add_keyframe(_keyframe(world.keyframes[k], near[k]))
    copy.heard = max(order, default=copy.heard)
    return copy


def _reference(world: GlobalMap, point: int) -> int:
    """The keyframe that a point goes with, or the oldest where that one does not see it."""
    viewers, carrier = world.points[point].keyframes, world.carrier(point)
    return carrier if carrier in viewers else min(viewers)


def _columns(world: GlobalMap, ids: Ids) -> tuple[Array, Array]:
    points = [world.points[p] for p in ids.tolist()]
    return np.array([p.position for p in points]), np.array([p.parallax_deg for p in points])


def _neighbours(world: GlobalMap, order: list[int], points: Ids) -> dict[int, list[int]]:
    """The keyframes that share most points with each, best first, as ``covisible`` says.

    For all at once: hundreds see each point of a small room, and a tracker that was started again is waited
    for.
    """
    if not len(points):
        return {k: [] for k in order}
    row = {k: i for i, k in enumerate(order)}
    viewers = [sorted(row[k] for k in world.points[p].keyframes) for p in points.tolist()]
    starts = np.concatenate([[0], np.cumsum([len(v) for v in viewers])])
    flat = np.array([k for v in viewers for k in v], np.intp)
    numbers, near = np.array(order, np.int64), {}
    for i, k in enumerate(order):
        mine = np.searchsorted(points, np.fromiter(world.keyframes[k].observed, np.int64))
        pieces = [flat[starts[m] : starts[m + 1]] for m in mine.tolist()]
        counts = np.bincount(np.concatenate([flat[:0], *pieces]), minlength=len(order))
        counts[i] = 0
        best = np.lexsort((-numbers, -counts))[:NEIGHBOURS]
        near[k] = numbers[best[counts[best] >= LEAST_SHARED]].tolist()
    return near


def _keyframe(source: GlobalKeyframe, neighbours: list[int]) -> LocalKeyframe:
    points = np.full(len(source.features), NO_POINT, np.int64)
    for point, keypoint in source.observed.items():
        points[keypoint] = point
    return LocalKeyframe(
        source.id,
        source.index,
        0,
        source.world_from_camera.copy(),
        source.camera,
        source.features,
        points,
        neighbours,
        twist=source.present_twist,
    )
