"""Applying what the backend changed to the local map."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from prism_edge.errors import ConfigError
from prism_edge.geometry.cameras import LONGEST_READOUT_MS, PINHOLE, Camera
from prism_edge.geometry.poses import Array, from_rt, inverse, normalised, transform
from prism_edge.messages import HOME, MapUpdate
from prism_edge.tracking.frame_tracking import TrackedFrame
from prism_edge.tracking.local_map import NO_POINT, LocalKeyframe, LocalMap
from prism_edge.tracking.mapping import depth_sigma, merge
from prism_edge.tracking.motion import Prediction
from prism_edge.tracking.point_table import Ids, Index
from prism_edge.tracking.pose_from_map import PoseFromMap
from prism_edge.tracking.submaps import Parts
from prism_edge.tracking.view import View

log = logging.getLogger("prism_edge.tracking")

MIN_COMMON = 15
MOST_GROWTH = math.log(1e3)  # between the units of two parts of a map
RIGID = 1e-9  # what a motion's scale may be off one by rounding


def see_through(lens: Camera, views: Iterable[LocalKeyframe | TrackedFrame]) -> None:
    """Move keypoints to where a lens that was found anew has them, in views that are by that camera."""
    for view in views:
        if view.camera != lens and view.camera.like(lens):
            view.features, view.camera = view.features.through(lens, view.camera), lens


def flaw(update: MapUpdate) -> str:
    """What makes an update unusable, in a few words; empty where nothing does."""
    together = (
        ("keyframes", "poses"),
        ("points", "positions"),
        ("points", "parallax_deg"),
        ("dropped_keyframes", "dropped_points"),
        ("fused_from", "fused_into"),
        ("added_keyframes", "added_points"),
        ("added_keyframes", "added_keypoints"),
    )
    for one, other in together:
        if len(getattr(update, one)) != len(getattr(update, other)):
            return f"its {one} and {other} are not equally many"
    if len(update.weights) not in (0, len(update.points)):
        return "its points and weights are not equally many"
    if len(update.loop_units) not in (0, 2):
        return "its units of joined parts are not two numbers"
    for name in ("poses", "positions", "parallax_deg", "weights", "loop_units"):
        if not np.isfinite(getattr(update, name)).all():
            return f"its {name} are not all finite"
    if len(update.loop_units) and abs(float(update.loop_units[0])) > MOST_GROWTH:
        return "its parts are of sizes that can't be"
    if not abs(update.readout_ms) <= LONGEST_READOUT_MS:
        return "its readout is none"
    if len(update.camera):
        try:
            Camera.from_array(PINHOLE, update.camera)
        except ConfigError as error:
            return f"its camera is none ({error})"
    return ""


def take_over(
    world: LocalMap, parts: Parts, update: MapUpdate, last: TrackedFrame | None, pose: PoseFromMap
) -> bool:
    """Do to the map, its parts and the last frame what the backend did; True where points became others."""
    motions = apply_correction(world, update, pose, parts)
    beside = _beside_frame(world, parts, last)
    world.weigh(update.points, update.weights)
    world.drop_observations(update.dropped_keyframes, update.dropped_points)
    became = join(world, update)
    if update.loop_query >= 0:
        if parts.merge(update.loop_query, update.loop_candidate, update.loop_units):
            at_home = parts.of(update.loop_query) == HOME
            where = "has its place in the map" if at_home else "is joined to another, whose place isn't known"
            log.info("the part of keyframe %d %s", update.loop_query, where)
        world.look_anew()  # a part, or one end of the map, was turned and scaled: it is seen from elsewhere
    if last is not None:
        if became:
            last.points = _renamed(last.points, became)
        start = _carried(motions.get(beside, np.eye(4)), last.world_from_camera)
        refit(world, last, start, pose)
    return bool(became)


def apply_correction(
    world: LocalMap, update: MapUpdate, pose: PoseFromMap, parts: Parts
) -> dict[int, Array]:
    """Move keyframes and points to where the backend put them.

    Points that are not among the update's go with the keyframe that created them or, where that was culled,
    with the next newer one. A keyframe newer than what it is based on, which the backend had not seen, is
    fitted to what it observes of corrected points and of those that others took along, and takes its own
    along. So is, where everything that the backend has is named, an older one that is not: it has never heard
    of that (but of those before the first that it has, nothing says where they belong). ``parts`` are those
    of before: a part may be moved by metres, and takes nothing of another along. One that a
    loop joins to another is of another size then, and so is what goes along with it.
    Returns each keyframe's motion (4, 4), new world from old: a similarity.
    """
    index = {int(k): i for i, k in enumerate(update.keyframes)}
    world.heard = max(world.heard, update.based_on)
    table = world.points
    known = table.known(update.points)
    rows = table.rows(update.points[known])
    table.position[rows] = update.positions[known]
    table.parallax_deg[rows] = np.maximum(update.parallax_deg[known], table.parallax_deg[rows])
    if len(rows):  # first, as views are fitted to them below
        angle = np.radians(np.maximum(table.parallax_deg[rows], 1e-3))
        sigma = depth_sigma(world.newest().camera.fx, angle)
        table.log_depth_sigma[rows] = np.minimum(table.log_depth_sigma[rows], sigma)
    corrected = np.zeros(len(table), bool)
    corrected[rows] = True
    keyframes = [world.keyframes[k] for k in sorted(world.keyframes)]
    owner = _owners(table.reference, [keyframe.id for keyframe in keyframes])
    follows = table.alive & ~corrected
    part = [parts.of(keyframe.id) for keyframe in keyframes]
    growth = _growth(update, parts)
    motions = np.tile(np.eye(4), (len(keyframes), 1, 1))
    placed = np.zeros(len(keyframes), bool)
    for i, keyframe in enumerate(keyframes):
        if keyframe.id in index:
            corrected_pose = update.poses[index[keyframe.id]]
            motions[i] = _similarity(keyframe.world_from_camera, corrected_pose, growth.get(part[i], 1.0))
            placed[i] = True
            keyframe.world_from_camera = corrected_pose
        if part[i] in growth:
            keyframe.twist = keyframe.twist * np.repeat((growth[part[i]], 1.0), 3)
    mine = np.flatnonzero(follows & placed[owner])
    along = motions[owner[mine]]
    turned = np.einsum("nij,nj->ni", along[:, :3, :3], table.position[mine])
    table.position[mine] = turned + along[:, :3, 3]
    moved = {part[row]: motions[row] for row in np.flatnonzero(placed)}  # of each part's newest
    unheard = _unheard(keyframes, placed, update.based_on) if update.everything else np.zeros_like(placed)
    for i, keyframe in enumerate(keyframes):
        if placed[i] or (keyframe.id <= update.based_on and not unheard[i]):
            continue
        old = keyframe.world_from_camera
        # What other keyframes created is in its new place by now, corrected or taken along.
        if unheard[i]:
            start, settled = motions[_beside(keyframes, i, placed)], corrected | placed[owner]
        else:
            start, settled = moved.get(part[i], np.eye(4)), corrected | (table.reference != keyframe.id)
        view = View(keyframe.camera, keyframe.features)
        keyframe.world_from_camera = fit(
            world, view, keyframe.points, _carried(start, old), pose, settled
        )
        motions[i] = _similarity(old, keyframe.world_from_camera, growth.get(part[i], 1.0))
        mine = np.flatnonzero(follows & (owner == i))
        table.position[mine] = transform(motions[i], table.position[mine])
        if unheard[i]:
            placed[i] = True
        else:
            moved[part[i]] = motions[i]
    return {keyframe.id: motions[row] for row, keyframe in enumerate(keyframes)}


def _beside_frame(world: LocalMap, parts: Parts, last: TrackedFrame | None) -> int:
    """The keyframe that a frame goes with: that with which it shares most points, else its part's newest."""
    nearest = None if last is None else world.nearest(last.points)
    return (nearest or parts.newest(world)).id


def _growth(update: MapUpdate, parts: Parts) -> dict[int, float]:
    """The part, if any, that a loop joins to an older one, and by how much its lengths grow."""
    if update.loop_query < 0 or not len(update.loop_units):
        return {}
    old, new = parts.of_both(update.loop_query, update.loop_candidate)
    return {} if old == new else {new: math.exp(float(update.loop_units[0]))}


def _similarity(before: Array, now: Array, growth: float) -> Array:
    """What takes points from where a camera saw them to where it does now, ``growth`` times as far away."""
    larger = np.diag([growth, growth, growth, 1.0])
    motion: Array = now @ larger @ inverse(before)
    return motion


def _carried(similarity: Array, pose: Array) -> Array:
    """A camera's pose, moved."""
    moved: Array = similarity @ pose
    growth = float(np.cbrt(np.linalg.det(similarity[:3, :3])))
    return moved if abs(growth - 1.0) < RIGID else from_rt(moved[:3, :3] / growth, moved[:3, 3])


def _owners(references: Ids, keyframes: list[int]) -> Index:
    """Which of the keyframes (their numbers, ascending) each point (n,) goes with."""
    return np.minimum(np.searchsorted(keyframes, references), len(keyframes) - 1)


def _unheard(keyframes: list[LocalKeyframe], placed: NDArray[np.bool_], based_on: int) -> NDArray[np.bool_]:
    """Which keyframes (ascending) the backend has never heard of, ``placed`` being all that it has."""
    numbers = np.array([keyframe.id for keyframe in keyframes], np.int64)
    return ~placed & np.maximum.accumulate(placed) & (numbers <= based_on)


def _beside(keyframes: list[LocalKeyframe], i: int, placed: NDArray[np.bool_]) -> int:
    """The row, of those ``placed``, that shares most points with row i; the one before where none does."""
    rows = {keyframe.id: row for row, keyframe in enumerate(keyframes)}
    known = (rows[k] for k in keyframes[i].neighbours if k in rows and placed[rows[k]])
    return next(known, i - 1)


def join(world: LocalMap, update: MapUpdate) -> dict[int, int]:
    """Do what a loop showed: make its double points one, let keyframes see points of the other end.

    Returns which point each double became.
    """
    became: dict[int, int] = {}
    # From the last one back: what a point became may have become another since.
    for old, kept in zip(update.fused_from[::-1].tolist(), update.fused_into[::-1].tolist(), strict=True):
        became[old] = became.get(kept, kept)
    survivors = np.array([became[old] for old in update.fused_from.tolist()], np.int64)
    merge(world, survivors, update.fused_from)
    taken: list[tuple[int, int]] = []
    for number, point, keypoint in zip(
        update.added_keyframes.tolist(),
        update.added_points.tolist(),
        update.added_keypoints.tolist(),
        strict=True,
    ):
        keyframe = world.keyframes.get(number)
        if keyframe is None or not 0 <= keypoint < len(keyframe.points):
            continue
        mine = int(keyframe.points[keypoint])
        if mine != NO_POINT:
            taken.append((point, mine))
        elif point not in keyframe.points:
            known = np.array([point], np.int64)
            if world.points.known(known)[0]:
                keyframe.points[keypoint] = point
                world.points.observations[world.points.rows(known)] += 1
    now = _make_way(world, np.array(taken, np.int64).reshape(-1, 2))
    return {old: now.get(kept, kept) for old, kept in became.items()} | now


def _renamed(points: Ids, became: dict[int, int]) -> Ids:
    """A frame's points under the names they have now; of two that are one it keeps the first."""
    now = np.array([became.get(point, point) for point in points.tolist()], np.int64)
    again = np.ones(len(now), bool)
    again[np.unique(now, return_index=True)[1]] = False
    now[again] = NO_POINT
    return now


def _make_way(world: LocalMap, taken: NDArray[np.int64]) -> dict[int, int]:
    """Points of the other end that were to come to keypoints where another stands by now, a seed mostly.

    ``taken`` (n, 2) are both. They are one, as the backend would have found had it known of the other, but
    where a keyframe tells them apart. Returns which point each became.
    """
    table = world.points
    pairs = taken[table.known(taken.ravel()).reshape(-1, 2).all(axis=1)]
    concerned = np.zeros(len(table), bool)
    concerned[table.rows(pairs.ravel())] = True
    seen_by = {point: set[int]() for point in pairs.ravel().tolist()}
    for keyframe in world.keyframes.values() if len(pairs) else ():
        seen = keyframe.points[keyframe.observed()]
        for point in seen[concerned.take(table.rows(seen))].tolist():
            seen_by[point].add(keyframe.id)
    one: list[tuple[int, int]] = []
    for point, mine in pairs.tolist():
        if seen_by[point].isdisjoint(seen_by[mine]):
            seen_by[point] |= seen_by[mine]
            one.append((point, mine))
    known = len(world.changes.fused)
    merge(world, *np.array(one, np.int64).reshape(-1, 2).T)
    return dict(world.changes.fused[known:])


def refit(world: LocalMap, last: TrackedFrame, start: Array, pose: PoseFromMap) -> None:
    """Place the last frame anew, from ``start`` (4, 4) on, where its surroundings have taken it."""
    start = normalised(start)
    if last.expected is not None:
        last.expected = last.expected.carried(start @ inverse(last.world_from_camera))
    view = View(last.camera, last.features, last.taken_ns)
    last.world_from_camera = fit(world, view, last.points, start, pose, prediction=last.expected)


def fit(
    world: LocalMap,
    view: View,
    points: Ids,
    start: Array,
    pose: PoseFromMap,
    usable: NDArray[np.bool_] | None = None,
    prediction: Prediction | None = None,
) -> Array:
    """world_from_camera that fits the points of a view, or ``start`` where too few are ``usable``."""
    keypoints = np.flatnonzero(points >= 0)
    keypoints = keypoints[world.points.known(points[keypoints])]
    rows = world.points.rows(points[keypoints])
    if usable is not None:
        keypoints, rows = keypoints[usable[rows]], rows[usable[rows]]
    # A product of corrections drifts off the group, and inverse() squares what it is off by.
    start = normalised(start)
    if len(rows) < MIN_COMMON:
        return start
    estimate = pose.estimate(world, view, start, rows, keypoints, prediction=prediction)
    return estimate.world_from_camera if estimate.inliers.sum() >= MIN_COMMON else start
