"""Images stamped by when they arrived, as over a network: some come together that were not taken so."""

from __future__ import annotations

import numpy as np
import pytest

from prism_edge.config import TrackingConfig
from prism_edge.geometry.poses import inverse, rotation_angle, se3_exp
from prism_edge.tracking.motion import ConstantVelocity
from prism_edge.tracking.tracker import Tracker
from tests.tracking.test_rolling_shutter import drawn

READOUT_MS = 26.0
WORLD = "sim:room?seed={}&speed=0.4&readout=26&width=320&height=240&frames=60"


# As they were taken 0.71 and 0.42 degrees (OpenCV 4.14: 0.85, 0.51); moved as by a leap 0.82 to 5.74.
@pytest.mark.parametrize(("seed", "most_deg"), [(4, 1.1), (7, 0.7)])
@pytest.mark.parametrize("together", [2, 3])
def test_rows_are_not_moved_as_by_a_leap(together: int, seed: int, most_deg: float) -> None:
    """Else a camera of which the readout is told is turned by degrees in the second of each two images."""
    source, images = drawn(WORLD.format(seed))
    tracker, off = Tracker(TrackingConfig(readout_ms=READOUT_MS)), []
    for index, (_, grey) in enumerate(images):
        since = index % together  # they arrive, 2 ms apart, when the last of them has been taken
        came_ns = images[min(index - since + together - 1, len(images) - 1)][0] + 2_000_000 * since
        result = tracker.process(index, came_ns, grey, source.camera)
        keyframe = tracker.maybe_keyframe()
        tracker.map_keyframe()
        if keyframe is not None:
            depth = source.depth(keyframe.index)
            tracker.add_depth(keyframe.id, depth, np.array([1.0, 0.0, 1.0, 0.0]), 0.01)
        if result.world_from_camera is not None:
            begun = tracker.world.keyframes[min(tracker.world.keyframes)]
            true = inverse(source.pose(begun.index)) @ source.pose(index)
            found = inverse(begun.world_from_camera) @ result.world_from_camera
            off.append(rotation_angle(found[:3, :3].T @ true[:3, :3]))
    assert len(off) > 50
    assert max(off) < np.radians(most_deg)


def test_two_images_are_apart_by_what_their_rows_take() -> None:
    motion, twist = ConstantVelocity(), np.array([0.1, 0.0, 0.2, 0.3, 0.0, -0.1])
    motion.least_s, step = 0.02, se3_exp(0.02 * twist)
    motion.follow(np.eye(4), step, 1_000_000)
    assert motion.twist == pytest.approx(twist)
    assert motion.predict(step, 2_000_000) == pytest.approx(step @ step), "the next one as well"
    motion.follow(step, step @ step @ step, 41_000_000)
    assert motion.twist == pytest.approx(twist), "farther apart they are as stamped"
