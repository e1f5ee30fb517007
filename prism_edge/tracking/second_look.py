"""A frame in which little matches, looked at once more beside a keyframe, without the map."""

from __future__ import annotations

import logging

import numpy as np

from prism_edge.geometry.poses import Array, inverse
from prism_edge.tracking.frame_tracking import FrameTracker, TrackedFrame
from prism_edge.tracking.initialisation import TwoViews, reconstruct
from prism_edge.tracking.local_map import NO_POINT, LocalKeyframe, LocalMap
from prism_edge.tracking.matching import match_corners
from prism_edge.tracking.point_table import Ids, Index
from prism_edge.tracking.point_trust import MIN_PROVEN
from prism_edge.tracking.submaps import Parts

log = logging.getLogger("prism_edge.tracking")

WEAK_MATCHES = 100
MISLED = 1.5  # as in first_map.py, but here parallax is needed too, which no pure turn has
MIN_POINTS = 30  # with parallax


def look_again(
    world: LocalMap,
    parts: Parts,
    frames: FrameTracker,
    frame: TrackedFrame,
    keyframe: LocalKeyframe,
    seed: int,
) -> TrackedFrame:
    """The frame as it is, or placed beside a keyframe by what looks alike where that contradicts it.

    ``keyframe`` is the one that the camera is at.

    Tracking looks for points where it expects them, so a few that agree with a wrong motion lead it on, away
    from all others. But looks alone also follow what moves: points that have stood their time in one place
    (point_trust.py) are believed, where a pose can rest on them; and no camera jumps. The way between the
    two has its length from the keyframe's points, and its uncertainty from those that are kept. A map of one
    keyframe is the affair of :func:`~prism_edge.tracking.first_map.begin_structure`.
    """
    if frame.matched >= WEAK_MATCHES or parts.size(world) < 2:
        return frame
    rows = world.points.rows(frame.points[frame.points != NO_POINT])
    if frames.proven(world, rows, frame.taken_ns).sum() >= MIN_PROVEN:
        return frame
    before, now = match_corners(keyframe.features, frame.features)
    if len(before) < MISLED * frame.matched:
        return frame
    views, ids = two_views(world, keyframe, frame, before, now, seed, MIN_POINTS)
    if views is None or not views.contradicts:
        return frame
    good = views.good & (ids != NO_POINT)
    points = np.full(len(frame.points), NO_POINT, np.int64)
    points[now[good]] = ids[good]
    log.debug("%d corners contradict the motion of %d points", views.good.sum(), frame.matched)
    pose = keyframe.world_from_camera @ views.first_from_second
    if frame.expected is not None and frame.expected.rules_out(pose):
        return frame  # somebody who crosses the picture is what most corners are of
    return frames.placed_anew(world, frame, pose, points)


def two_views(
    world: LocalMap,
    first: LocalKeyframe,
    frame: TrackedFrame,
    before: Index,
    now: Index,
    seed: int,
    least: int,
) -> tuple[TwoViews | None, Ids]:
    """What matched keypoints of a keyframe and a frame say, and the keyframe's point of each match.

    At ``least`` so many must have parallax.
    """
    table = world.points
    ids = first.points[before].copy()
    ids[~table.known(ids)] = NO_POINT
    placed = ids != NO_POINT
    depths: Array = np.full(len(before), np.nan)
    from_first = table.position[table.rows(ids[placed])] - first.world_from_camera[:3, 3]
    depths[placed] = from_first @ first.world_from_camera[:3, 2]
    views = reconstruct(
        frame.camera,
        first.features.pixels[before],
        frame.features.pixels[now],
        np.where(depths > 0, depths, np.nan),
        inverse(first.world_from_camera) @ frame.world_from_camera,
        seed,
        least,
    )
    return views, ids
