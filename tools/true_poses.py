"""Where the camera truly was when an image was taken, for tools that write or judge recordings."""

from __future__ import annotations

import numpy as np

from prism_edge.errors import PrismError
from prism_edge.evaluation.loops import pose_at
from prism_edge.evaluation.trajectory import TOGETHER_NS, Trajectory, nearest_rows
from prism_edge.geometry.poses import Array
from prism_edge.sources.truth import read_truth

SAME_NS = 100_000  # one stamp, written with fewer digits


def own_truth(folder: str) -> Trajectory:
    """The recording's own true poses, none where it has none. Raises SourceError for damaged ones."""
    truth = read_truth(folder)
    return Trajectory.of([]) if truth is None else Trajectory(*truth)


def why_unscored(folder: str) -> str:
    """Why a recording's own truth is of no use, in words; empty where it is."""
    try:
        return "" if len(own_truth(folder)) else f"{folder} has no truth"
    except PrismError as error:
        return f"the truth can't be read: {error}"


def pose_of_image(truth: Trajectory, stamp_ns: int) -> Array | None:
    """world_from_camera (4, 4) at an image's stamp; None where no true pose is near.

    A reference may have every tenth image's alone, between which nothing is made up. Motion capture has
    stamps of its own, at which no image was taken: interpolated between its poses.
    """
    if not len(truth):
        return None
    nearest = int(nearest_rows(truth.stamps, np.array([stamp_ns]))[0])
    gap = abs(int(truth.stamps[nearest]) - stamp_ns)
    if gap <= SAME_NS:
        return np.asarray(truth.poses[nearest])
    return pose_at(truth, stamp_ns) if gap <= TOGETHER_NS else None
