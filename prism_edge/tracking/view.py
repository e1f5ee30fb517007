"""One image as tracking goes by it."""

from __future__ import annotations

from dataclasses import dataclass

from prism_edge.geometry.cameras import Camera
from prism_edge.tracking.features import Features


@dataclass(frozen=True)
class View:
    """What a camera saw at one time, wherever it was."""

    camera: Camera
    features: Features
    taken_ns: int = 0  # stamp; 0: not later than the newest keyframe's
