"""What a new keyframe gives the map: triangulated points, further observations, fused doubles."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from prism_edge.geometry.poses import Array, inverse
from prism_edge.tracking.local_map import NO_POINT, LocalKeyframe, LocalMap
from prism_edge.tracking.matching import match_projected
from prism_edge.tracking.point_table import TRIANGULATED_DEG, Ids, Index
from prism_edge.tracking.pose_from_map import reference_origins
from prism_edge.tracking.pose_refinement import CHI2_2D_95
from prism_edge.tracking.projection import expected_octaves, project
from prism_edge.tracking.triangulation import match_epipolar, rays, triangulate

MIN_PARALLAX = np.radians(TRIANGULATED_DEG)
MIN_BASELINE = 0.015  # of the median depth
FUSE_DISTANCE, FUSE_RATIO, FUSE_RADIUS = 50, 0.9, 3.0
MATCHING_SIGMA_PX = 1.4  # of a disparity: two keypoints of one pixel each
NEIGHBOURS, SHARING, TRIANGULATING = 10, 10, 4  # covisible keyframes, best first


def depth_sigma(focal: float | Array, parallax: Array) -> Array:
    """Sigma of log depth of points seen under a parallax (rad) by a camera of this focal length (pixels)."""
    return MATCHING_SIGMA_PX / (focal * parallax)


def introduce(world: LocalMap, keyframe: LocalKeyframe) -> None:
    """A keyframe that has just come into the map learns of its neighbours, and they of it."""
    neighbours = world.covisible(keyframe, NEIGHBOURS)
    keyframe.neighbours = [k.id for k in neighbours]
    for k in neighbours:
        # In a place that is known for long most of them come and go.
        there = [n for n in k.neighbours if n in world.keyframes]
        k.neighbours = [keyframe.id, *there[: NEIGHBOURS - 1]]


def extending(world: LocalMap, keyframe: LocalKeyframe, scale_factors: Array) -> Iterator[None]:
    """All that a keyframe with neighbours gives the map, step by step.

    Between steps the map is sound: frames may be tracked in it, but nothing may leave it.
    """
    neighbours = [world.keyframes[k] for k in keyframe.neighbours]
    mature(world, keyframe, scale_factors)
    yield
    # Known points first, so that fewer corners are triangulated a second time.
    near = neighbours[:SHARING]
    doubles = [share_points(world, shareable(world, near), keyframe, scale_factors)]
    yield
    for _ in triangulating(world, keyframe, neighbours[:TRIANGULATING], scale_factors):
        yield
    mine = shareable(world, [keyframe])
    for k in near:
        doubles.append(share_points(world, mine, k, scale_factors))
        yield
    first, second = (np.concatenate(ids) for ids in zip(*doubles, strict=True))
    fuse(world, first, second)
    cull_recent_points(world, keyframe.id)


def triangulating(
    world: LocalMap, keyframe: LocalKeyframe, neighbours: list[LocalKeyframe], scale_factors: Array
) -> Iterator[int]:
    """New points between a keyframe and its neighbours; how many, after each that gives any."""
    _, depths = world.depths_in(keyframe)
    depths = depths[depths > 0]
    if len(depths) < 10:
        return
    nearest, farthest = np.quantile(depths, (0.02, 0.98))
    for other in neighbours:
        baseline = np.linalg.norm(other.world_from_camera[:3, 3] - keyframe.world_from_camera[:3, 3])
        if baseline < MIN_BASELINE * np.median(depths):
            continue
        a, b = match_epipolar(
            keyframe.camera,
            other.camera,
            inverse(keyframe.world_from_camera) @ other.world_from_camera,
            keyframe.features,
            other.features,
            keyframe.free(),
            other.free(),
            scale_factors,
            (0.4 * float(nearest), 3.0 * float(farthest)),
        )
        ray_a = rays(keyframe.camera, keyframe.features.pixels[a])
        ray_b = rays(other.camera, other.features.pixels[b])
        points, depth_a, depth_b, parallax = triangulate(
            keyframe.world_from_camera, other.world_from_camera, ray_a, ray_b
        )
        good = (parallax > MIN_PARALLAX) & (depth_a > 0) & (depth_b > 0)
        good &= np.isfinite(depth_a) & np.isfinite(depth_b)
        good &= _reprojects(keyframe, points, a, scale_factors) & _reprojects(other, points, b, scale_factors)
        # The same corner looks as much smaller as it is farther away.
        ratio = np.where(good, depth_b, 1.0) / np.where(good, depth_a, 1.0)
        level = scale_factors[keyframe.features.octaves[a]] / scale_factors[other.features.octaves[b]]
        good &= (ratio / level < 1.8) & (ratio / level > 1 / 1.8)
        a, b, parallax = a[good], b[good], parallax[good]
        if len(a) == 0:
            continue
        sigma = depth_sigma(keyframe.camera.fx, parallax)
        ids = world.add_points(keyframe, a, points[good], sigma, np.degrees(parallax))
        for point, row, keypoint in zip(ids, world.points.rows(ids), b, strict=True):
            world.add_observation(int(point), int(row), other, int(keypoint))
        yield len(a)


def _reprojects(
    keyframe: LocalKeyframe, points: Array, keypoints: Index, factors: Array
) -> NDArray[np.bool_]:
    pixels, _ = project(keyframe.camera, keyframe.world_from_camera, points)
    sigma = factors[keyframe.features.octaves[keypoints]]
    error = (pixels - keyframe.features.pixels[keypoints]) / sigma[:, None]
    return np.einsum("ij,ij->i", error, error) < CHI2_2D_95


def mature(world: LocalMap, keyframe: LocalKeyframe, scale_factors: Array) -> int:
    """Triangulate points that so far rest on depth or on little parallax; returns how many improved.

    A point's first ray and the new keyframe's give a better place once they differ by a degree and by
    more than what the point had before.
    """
    table = world.points
    keypoints = keyframe.observed()
    rows = table.rows(keyframe.points[keypoints])
    origins = reference_origins(world, rows)
    to_first = table.position[rows] - origins
    to_now = table.position[rows] - keyframe.world_from_camera[:3, 3]
    cosine = np.einsum("ij,ij->i", to_first, to_now)
    cosine /= np.maximum(np.linalg.norm(to_first, axis=1) * np.linalg.norm(to_now, axis=1), 1e-12)
    angle = np.arccos(np.clip(cosine, -1.0, 1.0))
    better = (angle > MIN_PARALLAX) & (np.degrees(angle) > 1.3 * table.parallax_deg[rows])
    improved = 0
    for reference in np.unique(table.reference[rows[better]]):
        first = world.keyframes.get(int(reference))
        if first is None or first is keyframe:
            continue
        mine = np.flatnonzero(better & (table.reference[rows] == reference))
        mine = mine[first.points[table.reference_keypoint[rows[mine]]] == table.ids[rows[mine]]]
        first_keypoints = table.reference_keypoint[rows[mine]]
        points, depth_a, depth_b, parallax = triangulate(
            first.world_from_camera,
            keyframe.world_from_camera,
            rays(first.camera, first.features.pixels[first_keypoints]),
            rays(keyframe.camera, keyframe.features.pixels[keypoints[mine]]),
        )
        good = (depth_a > 0) & (depth_b > 0) & np.isfinite(depth_a) & (parallax > MIN_PARALLAX)
        good &= _reprojects(first, points, first_keypoints, scale_factors)
        good &= _reprojects(keyframe, points, keypoints[mine], scale_factors)
        chosen = rows[mine[good]]
        # Points the backend has already adjusted over many views keep their place.
        fresh = table.parallax_deg[chosen] < 2.0
        table.position[chosen[fresh]] = points[good][fresh]
        table.parallax_deg[chosen] = np.degrees(parallax[good])
        table.log_depth_sigma[chosen] = depth_sigma(keyframe.camera.fx, parallax[good])
        world.changes.new_points.append(table.ids[chosen[fresh]])
        improved += len(chosen)
    return improved


def shareable(world: LocalMap, keyframes: list[LocalKeyframe]) -> Index:
    """Rows of the points that some keyframes see and whose depth is known well."""
    rows = world.rows_seen_by(keyframes, len(world.points))
    return rows.compress(world.points.log_depth_sigma.take(rows) < 0.1)


def share_points(world: LocalMap, rows: Index, target: LocalKeyframe, factors: Array) -> tuple[Ids, Ids]:
    """Let ``target`` observe points (:func:`shareable`) where they project onto a like keypoint.

    A keypoint that already has another point shows that both are one: such pairs are returned, to be
    fused.
    """
    table = world.points
    there = np.zeros(len(table), bool)
    there[table.rows(target.points.compress(target.points >= 0))] = True
    rows = rows.compress(~there.take(rows))
    positions = table.position.take(rows, axis=0)
    centres, inside = project(target.camera, target.world_from_camera, positions)
    rows, centres = rows.compress(inside), centres.compress(inside, axis=0)
    offset = target.world_from_camera[:3, 3] - positions.compress(inside, axis=0)
    distance = np.maximum(np.linalg.norm(offset, axis=1), 1e-9)
    expected = expected_octaves(table, rows, distance, factors)
    good = np.einsum("ij,ij->i", offset, table.direction.take(rows, axis=0)) > 0.5 * distance
    good &= (expected >= 0) & (expected < len(factors))
    rows, centres = rows.compress(good), centres.compress(good, axis=0)
    octave = expected.compress(good).astype(np.intp)
    query, keypoint = match_projected(
        target.features,
        centres,
        FUSE_RADIUS * factors[octave],
        octave,
        table.descriptor.take(rows, axis=0),
        FUSE_DISTANCE,
        FUSE_RATIO,
    )
    ids = table.ids[rows[query]]
    order = np.argsort(keypoint)
    for i in order[target.points[keypoint[order]] == NO_POINT].tolist():
        world.add_observation(int(ids[i]), int(rows[query[i]]), target, int(keypoint[i]))
    present = target.points[keypoint]
    doubles = present != ids
    return ids[doubles], present[doubles]


def fuse(world: LocalMap, first: Ids, second: Ids) -> None:
    """Make each pair of points one: the better observed keeps its place, and takes what saw the other."""
    table = world.points
    pairs = np.stack([first, second], axis=1)
    pairs = pairs[table.known(pairs.ravel()).reshape(-1, 2).all(axis=1) & (first != second)]
    rows = table.rows(pairs.ravel()).reshape(-1, 2)
    swap = table.observations[rows[:, 0]] < table.observations[rows[:, 1]]
    pairs[swap] = pairs[swap, ::-1]
    apart, taken = np.zeros(len(pairs), bool), set[int]()
    for i, pair in enumerate(pairs.tolist()):
        apart[i] = taken.isdisjoint(pair)  # a chain is left for the next keyframe
        if apart[i]:
            taken.update(pair)
    merge(world, pairs[apart, 0], pairs[apart, 1])


def merge(world: LocalMap, keep: Ids, drop: Ids) -> None:
    """Make each pair of points one: what saw the second sees the first. Unknown points are passed over.

    Several may become one; what would go on to become another is passed over. Where a keyframe saw more than
    one of those that are one now, one of its keypoints keeps it.
    """
    table = world.points
    into: dict[int, int] = {}
    keeping: set[int] = set()
    pairs = np.stack([keep, drop], axis=1)
    pairs = pairs[table.known(pairs.ravel()).reshape(-1, 2).all(axis=1) & (keep != drop)]
    rows = table.rows(pairs.ravel()).reshape(-1, 2)
    for (kept, dropped), (kept_row, dropped_row) in zip(pairs.tolist(), rows.tolist(), strict=True):
        if kept in into or dropped in into or dropped in keeping:
            continue
        into[dropped] = kept
        keeping.add(kept)
        table.found[kept_row] += table.found[dropped_row]
        table.visible[kept_row] += table.visible[dropped_row]
        table.alive[dropped_row] = False
    if not into:
        return
    into_row = np.full(len(table), -1, np.int64)
    into_row[table.rows(np.array(list(into)))] = table.rows(np.array(list(into.values())))
    present = np.zeros(len(table), bool)
    for keyframe in world.keyframes.values():
        observed = keyframe.observed()
        seen = table.rows(keyframe.points[observed])
        kept_rows = into_row[seen]
        moved = np.flatnonzero(kept_rows >= 0)
        if len(moved) == 0:
            continue
        present[seen] = True
        double = present[kept_rows[moved]]
        present[seen] = False
        first = np.zeros(len(moved), bool)
        first[np.unique(kept_rows[moved], return_index=True)[1]] = True
        double |= ~first
        keyframe.points[observed[moved]] = np.where(double, NO_POINT, table.ids[kept_rows[moved]])
        table.observations[kept_rows[moved[~double]]] += 1
    world.changes.fused.extend(into.items())


def cull_recent_points(world: LocalMap, newest: int) -> None:
    """Drop points that are rarely found where they should be, or that hardly any keyframe sees."""
    table = world.points
    age = newest - table.reference
    young = table.alive & (age <= 4)
    rarely = young & (table.visible > 8) & (table.found < 0.25 * table.visible)
    lonely = table.alive & (age >= 3) & (age <= 8) & (table.observations < 2)
    world.cull_points(np.flatnonzero(rarely | lonely))
