"""Finding the camera again in a map it was lost in, without an idea of where it is."""

from __future__ import annotations

import cv2
import numpy as np

from prism_edge.geometry.poses import Array
from prism_edge.tracking.features import Features
from prism_edge.tracking.frame_tracking import FrameTracker, TrackedFrame
from prism_edge.tracking.local_map import NO_POINT, LocalKeyframe, LocalMap
from prism_edge.tracking.matching import hamming
from prism_edge.tracking.perspective_pose import perspective_pose
from prism_edge.tracking.point_table import Ids
from prism_edge.tracking.point_trust import MIN_PROVEN
from prism_edge.tracking.projection import project
from prism_edge.tracking.view import View

MAX_DISTANCE = 60
MIN_INLIERS, PNP_PX = 15, 6.0
SUDDEN = 0.5  # of the previous frame's matches
CLEARLY = 1.1  # times as many
PROVEN_SHARE = 0.25  # of the points; what keeps ahead of the camera for long comes to have some, too


def match_keyframe(features: Features, keyframe: LocalKeyframe) -> tuple[Ids, Ids]:
    """Mutual nearest descriptors between a frame and a keyframe's points: (keypoint, point id)."""
    seen = keyframe.observed()
    if len(seen) == 0 or len(features) == 0:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    query = features.descriptors.view(np.uint8).reshape(-1, 32)
    train = np.ascontiguousarray(keyframe.features.descriptors[seen]).view(np.uint8).reshape(-1, 32)
    matches = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(query, train)
    a = np.array([m.queryIdx for m in matches], np.int64)
    b = np.array([m.trainIdx for m in matches], np.int64)
    close = hamming(features.descriptors[a], keyframe.features.descriptors[seen[b]]) <= MAX_DISTANCE
    return a[close], keyframe.points[seen[b[close]]]


def locate(world: LocalMap, view: View, keyframe: LocalKeyframe, seed: int) -> Array | None:
    """Pose (world_from_camera) by perspective-n-point RANSAC on one keyframe's points; None if it fails."""
    keypoints, ids = match_keyframe(view.features, keyframe)
    known = world.points.known(ids)
    keypoints, ids = keypoints[known], ids[known]
    if len(ids) < MIN_INLIERS:
        return None
    cv2.setRNGSeed(seed)
    positions = world.points.position[world.points.rows(ids)]
    pixels = view.features.pixels[keypoints]
    return perspective_pose(positions, pixels, view.camera.matrix, PNP_PX, 0.99, MIN_INLIERS)


def placed_at(
    world: LocalMap,
    frames: FrameTracker,
    view: View,
    keyframe: LocalKeyframe,
    least: int,
    seed: int,
) -> TrackedFrame | None:
    """The frame where it fits what a keyframe sees, and what those see that share points with it."""
    pose = locate(world, view, keyframe, seed)
    if pose is None:
        return None
    frames.refresh_local_map(world, keyframe.points[keyframe.observed()])
    return frames.track(world, view, pose, None, least)


def recover(
    world: LocalMap,
    frames: FrameTracker,
    view: View,
    newest: LocalKeyframe,
    least: int,
    seed: int,
) -> TrackedFrame | None:
    """Look for the camera among the newest keyframes and those that shared points with them.

    Looks alone follow what moves, too: a place where the camera can't have gone (``frames.expected``) is
    believed only where many of the points have stood their time, and are not where they were expected.
    """
    for keyframe in [newest, *world.covisible(newest, 2)]:
        frame = placed_at(world, frames, view, keyframe, least, seed)
        if frame is not None and frame.matched >= least and not _made_up(world, frames, frame):
            return frame
    return None


def _made_up(world: LocalMap, frames: FrameTracker, frame: TrackedFrame) -> bool:
    expected = frame.expected
    if expected is None or not expected.rules_out(frame.world_from_camera):
        return False
    table, keypoints = world.points, np.flatnonzero(frame.points != NO_POINT)
    rows = table.rows(frame.points[keypoints])
    there, _ = project(frame.camera, expected.world_from_camera, table.position[rows])
    elsewhere = np.hypot(*(frame.features.pixels[keypoints] - there).T) > PNP_PX
    standing = frames.proven(world, rows, frame.taken_ns) & elsewhere
    return int(np.sum(standing)) < max(MIN_PROVEN, PROVEN_SHARE * len(rows))


def misled(frame: TrackedFrame | None, previous: TrackedFrame | None, least: int) -> bool:
    """Whether a frame was not tracked, or suddenly by so few points that they may agree by chance.

    In a wide search for the hundreds of points of a first map thirty to two hundred did, half a metre away.
    """
    if frame is None or frame.matched < least:
        return True
    return previous is not None and frame.matched < SUDDEN * previous.matched


def clearly_better(frame: TrackedFrame | None, other: TrackedFrame | None) -> TrackedFrame | None:
    """A placement of a frame, or another one that clearly more points agree with."""
    if frame is None or (other is not None and other.matched > CLEARLY * frame.matched):
        return other
    return frame
