"""Rolling shutters: rows are read one after the other, and a camera that moves sees each from elsewhere.

Keypoints are moved to where the camera would have seen them in the middle of the readout, the time of the
frame's pose; from there on the image is as if taken at once. First by the motion that is expected, and once
the frame is placed by the motion that it had; where a map begins, by how corners went since the frame before.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Protocol

import numpy as np

from prism_edge.geometry.cameras import Camera
from prism_edge.geometry.poses import Array
from prism_edge.tracking.features import Features
from prism_edge.tracking.frame_tracking import FrameTracker, TrackedFrame
from prism_edge.tracking.local_map import LocalKeyframe, LocalMap
from prism_edge.tracking.motion import LONGEST_S
from prism_edge.tracking.triangulation import rays
from prism_edge.tracking.turn_between import turn_between
from prism_edge.tracking.view import View

LEAST = 0.5  # of a ray's depth that is left: a wrong motion, however fast, turns no ray away


def seen_at_once(pixels: Array, camera: Camera, twist: Array, depth: float, readout_ms: float) -> Array:
    """Ideal pixels (n, 2) of a camera that moves by ``twist`` a second, as of the middle of its readout.

    ``twist`` (6,) is the camera's, translation first, in its own frame and in the unit of ``depth``, what
    most of the scene is away: the turning is exact to first order, the shift that of a wall there. The same
    pixels where there is no readout, or a motion or a depth that nobody knows.
    """
    if not (readout_ms and twist.any() and np.isfinite(twist).all() and depth > 0.0):
        return pixels
    rows = camera.distort_pixels(pixels)[:, 1]
    after_s = ((rows + 0.5) / camera.height - 0.5) * (1e-3 * readout_ms)
    seen = rays(camera, pixels)
    seen += after_s[:, None] * (np.cross(twist[3:], seen) + twist[:3] / depth)
    return camera.to_pixels(seen[:, :2] / np.maximum(seen[:, 2:], LEAST))


class RollingShutter:
    """A camera's readout; does nothing to what a global shutter sees."""

    def __init__(self, set_ms: float) -> None:
        """``set_ms``: from the first row to the last; below 0 where the last is read first.

        0: as each frame's camera says and, where it doesn't, as the backend finds.
        """
        self._set_ms, self.is_said = set_ms, bool(set_ms)
        self.readout_ms = set_ms  # of the last frame
        self._before: View | None = None  # keypoints as taken
        self._now: View | None = None

    def in_the_middle(self, view: View, twist: Array, depth: float) -> View:
        """A view whose keypoints are :func:`seen_at_once`; the same one where none is to be moved."""
        features = _moved(view, twist, depth, self.readout_ms)
        return view if features is view.features else replace(view, features=features)

    def placed(
        self, world: LocalMap, frames: FrameTracker, frame: TrackedFrame, raw: View, twist: Array,
        depth: float,
    ) -> TrackedFrame:
        """A frame placed once more, its ``raw`` keypoints moved by the motion that it turned out to have."""
        seen = self.in_the_middle(raw, twist, depth)
        return frame if seen.features is frame.features else frames.seen_again(world, frame, seen)

    def saw(self, view: View, said_ms: float | None = None, found_ms: float = 0.0) -> None:
        """A frame has come, with keypoints as they were taken.

        ``said_ms`` is what its camera says, ``found_ms`` what counts where that says nothing.
        """
        self.is_said = bool(self._set_ms) or said_ms is not None
        self.readout_ms = self._set_ms or (found_ms if said_ms is None else said_ms)
        if self.readout_ms:
            self._before, self._now = self._now, view

    @property
    def least_s(self) -> float:
        """What two images are apart at least: the second's rows are read after the first's."""
        return 1e-3 * abs(self.readout_ms)

    @property
    def found_ms(self) -> float:
        """What was found for the last frame's camera, where nobody says it: a next map may begin with it."""
        return 0.0 if self.is_said else self.readout_ms

    @property
    def may_begin(self) -> bool:
        """Whether a map may begin with this frame: not with the first of all, whose motion nothing tells."""
        return self._before is not None or not self.readout_ms

    def without_map(self, view: View) -> View:
        """The last frame's view, its keypoints moved by how its corners went since the frame before.

        A shift counts as the turn that looks like it, so no depth is needed. They stay where too few corners
        agree on one, or the two frames are too far apart.
        """
        if self._before is None or self._now is None:
            return view
        elapsed_s = (self._now.taken_ns - self._before.taken_ns) * 1e-9
        if not 0 < elapsed_s < LONGEST_S:
            return view
        turn, twist = turn_between(view.camera, self._before.features, view.features), np.zeros(6)
        twist[3:] = 0.0 if turn is None else turn / max(elapsed_s, self.least_s)
        return self.in_the_middle(view, twist, 1.0)


class Seen(Protocol):
    """What a map of keyframes says of the cameras that made it."""

    readout_ms: float

    @property
    def keyframes(self) -> Mapping[int, Any]:
        """By their numbers; each has its ``camera``."""


def found_readout(world: Seen, camera: Camera) -> float:
    """The readout that was found in a map, ms, for a camera that may have made it; 0 for another.

    It was found while one camera had made all of the map: that of its oldest keyframe.
    """
    if not (world.readout_ms and world.keyframes):
        return world.readout_ms
    return world.readout_ms if world.keyframes[min(world.keyframes)].camera.like(camera) else 0.0


def see_at_once(
    world: LocalMap, readout_ms: float, last: TrackedFrame | None, twist: Array, depth: float
) -> None:
    """Move all keyframes' keypoints by as much as a readout is another than was found before.

    And those of the ``last`` frame, by its ``twist`` and ``depth``: it is held against the others.
    """
    more_ms, world.readout_ms = readout_ms - world.readout_ms, readout_ms
    if not more_ms:
        return
    for keyframe in world.keyframes.values():
        keyframe.features = _moved(keyframe, keyframe.twist, world.median_depth(keyframe), more_ms)
    if last is not None:
        last.features = _moved(last, twist, depth, more_ms)


def _moved(
    view: View | LocalKeyframe | TrackedFrame, twist: Array, depth: float, more_ms: float
) -> Features:
    pixels = seen_at_once(view.features.pixels, view.camera, twist, depth, more_ms)
    return view.features if pixels is view.features.pixels else view.features.at(pixels, view.camera)
