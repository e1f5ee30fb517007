"""When a tracked frame becomes a keyframe."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from prism_edge.config import TrackingConfig
from prism_edge.geometry.poses import inverse, rotation_angle
from prism_edge.tracking.frame_tracking import TrackedFrame
from prism_edge.tracking.local_map import LocalKeyframe

BASELINE = 0.08  # of the median depth: new rays are worth adding
UNCOVERED = 0.4  # share of the image with corners but no points: new ground
MOVED_BASELINE, MOVED_ANGLE = 0.01, np.radians(2.0)
WEAK_MATCHES, WEAK_GAP_S = 120, 0.05  # so few points must be added to at once
_CELL = 64


@dataclass(frozen=True)
class Decision:
    """Whether to make a keyframe, and the reason in a word (for the log)."""

    wanted: bool
    reason: str = ""


def decide(
    config: TrackingConfig,
    frame: TrackedFrame,
    reference: LocalKeyframe,
    seconds_since: float,
    reference_matches: int,
    median_depth: float,
) -> Decision:
    """Judge a tracked frame against the newest keyframe.

    ``reference_matches`` is how many points the frame right after that keyframe matched.
    """
    if seconds_since < (config.keyframe_min_s if frame.matched >= WEAK_MATCHES else WEAK_GAP_S):
        return Decision(False)
    relative = inverse(reference.world_from_camera) @ frame.world_from_camera
    baseline = float(np.linalg.norm(relative[:3, 3])) / max(median_depth, 1e-9)
    turned = rotation_angle(relative[:3, :3])
    if baseline < MOVED_BASELINE and turned < MOVED_ANGLE:
        return Decision(False)
    if frame.matched < max(config.keyframe_ratio * reference_matches, WEAK_MATCHES):
        return Decision(True, "few matches")
    if baseline > BASELINE:
        return Decision(True, "baseline")
    if seconds_since > config.keyframe_max_s:
        return Decision(True, "time")
    if uncovered_share(frame) > UNCOVERED:
        return Decision(True, "new ground")
    return Decision(False)


def uncovered_share(frame: TrackedFrame) -> float:
    """Share of the image cells with at least 3 keypoints in which none has a point."""
    pixels = frame.features.pixels
    columns = frame.camera.width // _CELL + 1
    cell = np.clip(pixels[:, 1] // _CELL, 0, None).astype(int) * columns
    cell += np.clip(pixels[:, 0] // _CELL, 0, columns - 1).astype(int)
    count = np.bincount(cell)
    matched = np.bincount(cell[frame.points >= 0], minlength=len(count))
    textured = count >= 3
    return float((matched[textured] == 0).mean()) if textured.any() else 0.0
