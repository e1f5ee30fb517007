"""When a tracked frame becomes a keyframe, and when an older keyframe does as well."""

from __future__ import annotations

import numpy as np

from prism_edge.config import TrackingConfig
from prism_edge.geometry.poses import Array, inverse, rotation_angle
from prism_edge.tracking.frame_tracking import TrackedFrame
from prism_edge.tracking.local_map import LocalKeyframe, LocalMap
from prism_edge.tracking.point_table import Ids

BASELINE = 0.08  # of the median depth: new rays are worth adding
UNCOVERED = 0.4  # share of the image with corners but no points: new ground
MOVED_BASELINE, MOVED_ANGLE = 0.01, np.radians(2.0)
WEAK_MATCHES, WEAK_GAP_S = 120, 0.05  # so few points must be added to at once
# How near an older keyframe must be to show the same: of the median depth, and of its points in sight.
SAME_BASELINE, SAME_ANGLE, SAME_SHARE = 0.04, np.radians(5.0), 0.4
# The newest keyframes are no place that was left. None of them is culled either: depth and corrections for
# them are on their way, and the next frames are tracked on them.
RECENT = 12
KNOWN_S = 10.0  # even so one is made that often: depth, scale, loops and the journal go by keyframes
_CELL = 64


def decide(
    config: TrackingConfig,
    frame: TrackedFrame,
    reference: LocalKeyframe,
    seconds_since: float,
    reference_matches: int,
    median_depth: float,
) -> str:
    """Why a tracked frame, beside the keyframe that the camera is at, is to become one; empty: it is not.

    ``seconds_since`` counts from when it came there, ``reference_matches`` is how many points the frame right
    after matched.
    """
    if seconds_since < (config.keyframe_min_s if frame.matched >= WEAK_MATCHES else WEAK_GAP_S):
        return ""
    relative = inverse(reference.world_from_camera) @ frame.world_from_camera
    baseline = float(np.linalg.norm(relative[:3, 3])) / max(median_depth, 1e-9)
    turned = rotation_angle(relative[:3, :3])
    if baseline < MOVED_BASELINE and turned < MOVED_ANGLE:
        return ""
    if frame.matched < max(config.keyframe_ratio * reference_matches, WEAK_MATCHES):
        return "few matches"
    if baseline > BASELINE:
        return "baseline"
    if seconds_since > config.keyframe_max_s:
        return "time"
    if uncovered_share(frame) > UNCOVERED:
        return "new ground"
    return ""


def shown_before(world: LocalMap, frame: TrackedFrame, median_depth: float) -> LocalKeyframe | None:
    """The nearest keyframe that shows what a frame does, from as good as the same place; None without one."""
    if frame.matched < WEAK_MATCHES or len(world.keyframes) <= RECENT:
        return None
    older = [world.keyframes[k] for k in sorted(world.keyframes)[:-RECENT]]
    return same_view(older, frame.world_from_camera, frame.points, median_depth)


def is_overdue(world: LocalMap, stamp_ns: int) -> bool:
    """Whether a known place gets a keyframe: none was made for KNOWN_S, as in a map of an earlier run."""
    return abs(stamp_ns - world.newest().stamp_ns) > 1e9 * KNOWN_S


def same_view(
    keyframes: list[LocalKeyframe], world_from_camera: Array, points: Ids, median_depth: float
) -> LocalKeyframe | None:
    """The nearest of some keyframes from as good as the same place, most of whose ``points`` are these."""
    poses, here = np.array([keyframe.world_from_camera for keyframe in keyframes]), world_from_camera
    away = np.linalg.norm(poses[:, :3, 3] - here[:3, 3], axis=1) / max(median_depth, 1e-9)
    cosine = (np.einsum("ij,nij->n", here[:3, :3], poses[:, :3, :3]) - 1.0) / 2.0
    near = np.flatnonzero((away < SAME_BASELINE) & (cosine > np.cos(SAME_ANGLE)))
    for i in near[np.argsort(away[near])].tolist():
        theirs = keyframes[i].points[keyframes[i].observed()]
        if len(theirs) and np.isin(theirs, points).mean() >= SAME_SHARE:
            return keyframes[i]
    return None


def uncovered_share(frame: TrackedFrame) -> float:
    """Share of the image cells with at least 3 keypoints in which none has a point."""
    pixels = frame.features.pixels
    columns = frame.camera.width // _CELL + 1
    cell = np.maximum(pixels[:, 1] // _CELL, 0).astype(int) * columns
    cell += np.minimum(np.maximum(pixels[:, 0] // _CELL, 0), columns - 1).astype(int)
    count = np.bincount(cell)
    matched = np.bincount(cell[frame.points >= 0], minlength=len(count))
    textured = count >= 3
    return float((matched[textured] == 0).mean()) if textured.any() else 0.0
