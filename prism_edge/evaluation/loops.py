"""Every loop that the backend accepted, held against the truth; pure. Definitions: docs/EVALUATION.md."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from prism_edge.evaluation.trajectory import NS, Trajectory
from prism_edge.geometry.poses import Array, inverse, rotation_angle, scaled, se3_exp, se3_log
from prism_edge.messages import MapSnapshot, Tracked

MOST_SHIFT_M, MOST_SHIFT_SHARE = 0.2, 0.1  # a right loop is within this, and this share of the distance
MOST_TURN_DEG = 5.0
WIDEST_GAP_NS = NS  # between true poses that one may lie between


def judge_loops(
    snapshot: MapSnapshot | None,
    frames: Iterable[Tracked],
    truth: Trajectory | None,
    scale_ratio: float | None,
) -> dict[str, Any]:
    """Counts, precision, and each loop with its error (``right`` None where there is no true pose).

    A loop in wrong metres may still join the right places: ``scale_ratio``, which fits the whole final path
    to the truth, takes the metres' part out of ``same_place`` and ``place_precision`` (None without it).
    """
    if snapshot is None:
        return {"accepted": 0, "judged": 0, "precision": None, "place_precision": None, "list": []}
    stamps = {frame.index: frame.stamp_ns for frame in frames}
    factor = float(np.exp(snapshot.log_scale))
    rows = []
    for query, candidate, pose, inliers in zip(
        snapshot.loop_queries.tolist(),
        snapshot.loop_candidates.tolist(),
        snapshot.loop_poses,
        snapshot.loop_inliers.tolist(),
        strict=True,
    ):
        row: dict[str, Any] = {
            "query_frame": query,
            "candidate_frame": candidate,
            "inliers": inliers,
            "right": None,
            "same_place": None,
            "translation_error_m": None,
            "rotation_error_deg": None,
        }
        ends = [None if truth is None else pose_at(truth, stamps.get(i)) for i in (query, candidate)]
        if ends[0] is not None and ends[1] is not None:
            true, found = inverse(ends[1]) @ ends[0], scaled(pose, factor)
            row.update(_against(true, found))
            if scale_ratio is not None:
                row["same_place"] = _against(true, scaled(found, scale_ratio))["right"]
        rows.append(row)
    return {
        "accepted": len(rows),
        "judged": sum(row["right"] is not None for row in rows),
        "precision": _share(rows, "right"),
        "place_precision": _share(rows, "same_place"),
        "list": rows,
    }


def _share(rows: list[dict[str, Any]], of: str) -> float | None:
    judged = [row[of] for row in rows if row[of] is not None]
    return sum(judged) / len(judged) if judged else None


def _against(true: Array, found: Array) -> dict[str, Any]:
    off = inverse(true) @ found
    shift = float(np.linalg.norm(found[:3, 3] - true[:3, 3]))
    turn = float(np.degrees(rotation_angle(off[:3, :3])))
    near = MOST_SHIFT_M + MOST_SHIFT_SHARE * float(np.linalg.norm(true[:3, 3]))
    return {
        "right": bool(shift <= near and turn <= MOST_TURN_DEG),
        "translation_error_m": shift,
        "rotation_error_deg": turn,
    }


def pose_at(truth: Trajectory, stamp_ns: int | None) -> Array | None:
    """The true pose at a stamp, interpolated between two at most a second apart; None outside of those."""
    if stamp_ns is None or not len(truth):
        return None
    after = int(np.searchsorted(truth.stamps, stamp_ns))
    if after < len(truth) and truth.stamps[after] == stamp_ns:
        return truth.poses[after]
    if after == 0 or after == len(truth):
        return None
    start, end = int(truth.stamps[after - 1]), int(truth.stamps[after])
    if end - start > WIDEST_GAP_NS:
        return None
    step = se3_log(inverse(truth.poses[after - 1]) @ truth.poses[after])
    return np.asarray(truth.poses[after - 1] @ se3_exp(step * ((stamp_ns - start) / (end - start))))
