"""A young map, checked against its own matches: one that began with near and far exchanged shows it later."""

from __future__ import annotations

import logging

import cv2
import numpy as np

from prism_edge.geometry.poses import inverse
from prism_edge.tracking.frame_tracking import TrackedFrame
from prism_edge.tracking.initialisation import essential_pose
from prism_edge.tracking.local_map import NO_POINT, LocalKeyframe, LocalMap
from prism_edge.tracking.submaps import Parts
from prism_edge.tracking.two_view_pose import lead_apart, refine_two_view_pose

log = logging.getLogger("prism_edge.tracking")

YOUNG = 12  # keyframes since a map's first; by then its points have been seen from far enough apart
EARLY, VOICES = 3, 2  # keyframes that a map began with, and how many of them must say so
MIN_SHARED = 60  # points
MIN_PARALLAX_DEG = 2.0  # median of what is shared: under less both shapes fit alike
APART = np.radians(30.0)
CLEARLY = 1.5  # times the cost


def is_contradicted(world: LocalMap, parts: Parts, frame: TrackedFrame, seed: int) -> bool:
    """Whether the points of a young map fit another motion clearly better than the one it has.

    Of a part that began after the camera was lost nothing is said: the map is more than that.

    Of a plane two views allow two motions, and under little parallax stairs are one: a map may begin with the
    wrong one, near and far exchanged, and then tracks what fits it. Seen from farther apart that fits the
    true motion better: asked are the pixels alone of what ``frame`` shares with each of the first keyframes.
    """
    made = sorted(world.keyframes)
    if not parts.at_home or made[-1] - made[0] >= YOUNG:
        return False
    against = [_contradicts(world, world.keyframes[k], frame, seed) for k in made[:VOICES]]
    if any(against):  # else all the others together are too few
        against += [_contradicts(world, world.keyframes[k], frame, seed) for k in made[VOICES:EARLY]]
    if sum(against) < VOICES:
        return False
    log.info("what the first keyframes share fits another motion than theirs: a new map begins")
    return True


def _contradicts(world: LocalMap, early: LocalKeyframe, frame: TrackedFrame, seed: int) -> bool:
    seen = np.flatnonzero(frame.points != NO_POINT)
    ids, before, among = np.intersect1d(early.points, frame.points[seen], return_indices=True)
    if len(ids) < MIN_SHARED:
        return False
    if np.median(world.points.parallax_deg[world.points.rows(ids)]) < MIN_PARALLAX_DEG:
        return False
    first, second = early.features.pixels[before], frame.features.pixels[seen[among]]
    # Most fit one motion, so the fastest search finds it: plain RANSAC takes five times as long.
    found = essential_pose(frame.camera, first, second, seed, cv2.USAC_FAST)
    if found is None:
        return False
    mapped = inverse(early.world_from_camera) @ frame.world_from_camera
    if not lead_apart(found[0], mapped, APART):
        return False  # as nearly always, and refining takes longest
    _, cost = refine_two_view_pose(frame.camera, first, second, found[0])
    _, mapped_cost = refine_two_view_pose(frame.camera, first, second, mapped)
    return CLEARLY * cost < mapped_cost
