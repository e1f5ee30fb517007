"""A tracker that is fed with the generated film, and what it said."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from prism_edge.config import TrackingConfig
from prism_edge.tracking.tracker import FrameResult, Tracker
from tests.tracking.footage import IDENTITY, footage

CONFIG = TrackingConfig(features=500, max_features=500)
BLACK = np.zeros((240, 320), np.uint8)


@dataclass
class Run:
    """A tracker and what it said."""

    tracker: Tracker = field(default_factory=lambda: Tracker(CONFIG))
    results: dict[int, FrameResult] = field(default_factory=dict)
    keyframes: dict[int, int] = field(default_factory=dict)  # id: frame
    found_at: int = -1

    def feed(self, index: int, image: np.ndarray | None = None, at: int | None = None) -> FrameResult:
        """Frame ``index`` of the film (or another image) as frame ``at``."""
        film = footage()
        at = index if at is None else at
        image = film.images[index] if image is None else image
        result = self.tracker.process(at, film.stamp_ns(at), image, film.camera)
        self.results[at] = result
        keyframe = self.tracker.maybe_keyframe()
        self.tracker.map_keyframe()
        if keyframe is not None:
            self.keyframes[keyframe.id] = at
        return result

    def until_found(self, views: list[tuple[int, np.ndarray | None]], at: int) -> FrameResult:
        """Feed one view after the other; the first that is placed, which is ``found_at``."""
        for i, (index, image) in enumerate(views):
            result = self.feed(index, image, at=at + i)
            if result.world_from_camera is not None:
                self.found_at = at + i
                return result
        raise AssertionError("it was not found")

    def depth(self, keyframe: int, of: int | None = None, factor: float = 1.0) -> int:
        """The film's own depth of a keyframe."""
        frame = self.keyframes[keyframe] if of is None else of
        return self.tracker.add_depth(keyframe, factor * footage().depths[frame], IDENTITY, 0.1)

    def play(self, frames: range, depth_for: str = "all") -> None:
        for i in frames:
            known = set(self.keyframes)
            self.feed(i)
            for k in set(self.keyframes) - known:
                if depth_for == "all" or (depth_for == "first" and k == 0):
                    self.depth(k)

    def errors(self, frames: range) -> np.ndarray:
        """Distance (m) of each published pose from the truth, in the frame of the first image."""
        poses = footage().poses
        return np.array(
            [np.linalg.norm((self.results[i].world_from_camera - poses[i])[:3, 3]) for i in frames]
        )
