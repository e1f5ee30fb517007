"""A lost camera among places that look alike: what fits best is taken, though the first to fit is another."""

from __future__ import annotations

import numpy as np
import pytest

from prism_edge.geometry.poses import inverse, se3_log
from prism_edge.tracking.frame_tracking import FrameTracker, TrackedFrame
from prism_edge.tracking.local_map import LocalMap
from prism_edge.tracking.relocalisation import CONSIDERED_NS, CONVINCING, TRIES, Relocaliser
from prism_edge.tracking.view import View
from tests.tracking.cloud import CAMERA, FACTORS, Cloud, pose_at

FRAME_NS = 33_333_333
APART = 20.0  # m, beyond what either place sees
THERE = pose_at(APART)


def corridor(places: int = 2, alike: float = 0.35) -> tuple[Cloud, LocalMap]:
    """A share of what is seen at the last place is also at all the others, as far apart as can't be seen."""
    cloud, rng = Cloud(600, seed=2), np.random.default_rng(3)
    positions, words = cloud.positions, cloud.descriptors
    shared = rng.random(len(positions)) < alike
    for k in range(places - 1):
        others = Cloud(600, seed=10 + k)
        there, theirs = others.positions.copy(), others.descriptors.copy()
        there[shared], theirs[shared] = positions[shared], words[shared]
        there[:, 0] += APART * (k + 1)
        cloud.positions = np.concatenate([cloud.positions, there])
        cloud.descriptors = np.concatenate([cloud.descriptors, theirs])
    poses = [pose_at(APART * k + 0.3 * step) for k in range(places) for step in (0, 1)]
    return cloud, cloud.mapped(poses)[0]


class Lost:
    def __init__(self, world: LocalMap, last: int | None) -> None:
        self.world, self.frames, self.relocaliser = world, FrameTracker(FACTORS, 5000), Relocaliser()
        self.last = None if last is None else TrackedFrame.of_keyframe(world.keyframes[last], 100)
        self.frames.learns = False  # as of a camera that is lost
        self.relocaliser.begin()
        self.now_ns = 10_000_000_000

    def found(self, cloud: Cloud, true: np.ndarray, most: int = 60) -> tuple[TrackedFrame | None, int]:
        """The place and after how many frames, of a camera that stands at ``true``."""
        for i in range(most):
            self.now_ns += FRAME_NS
            view = View(CAMERA, cloud.view(true, noise_px=0.3, bits=10)[0], self.now_ns)
            found = self.relocaliser.attempt(self.world, self.frames, view, self.last, 25)
            if found is not None:
                return found, i + 1
        return None, most


def off(found: TrackedFrame, true: np.ndarray) -> float:
    return float(np.abs(se3_log(inverse(true) @ found.world_from_camera)).max())


def test_where_it_was_lost_fits_a_third_and_another_place_all() -> None:
    cloud, world = corridor()
    true = THERE @ pose_at(0.1, 0.02, 0.0, 0.01)
    found, _ = Lost(world, last=0).found(cloud, true)
    assert found is not None
    assert off(found, true) < 0.02
    assert found.matched > 300


def test_a_better_place_that_is_found_last_of_all_needs_a_second_frame_as_any() -> None:
    """The newest keyframes come first and the oldest next: all have had their turn with the third frame."""
    cloud, world = corridor(places=3)
    found, frames = Lost(world, last=0).found(cloud, THERE)
    assert found is not None
    assert off(found, THERE) < 0.02
    assert frames == len(world.keyframes) / TRIES + 1


def test_where_all_is_found_it_is_taken_at_once() -> None:
    cloud, world = corridor()
    true = pose_at(0.05, 0.0, 0.0, 0.01)
    found, frames = Lost(world, last=0).found(cloud, true)
    assert found is not None
    assert off(found, true) < 0.02
    assert frames == 2, "one frame alone is not believed"


@pytest.mark.parametrize("places", [2, 5])
def test_a_doubtful_place_is_taken_once_no_other_fits_better(places: int) -> None:
    """Two thirds of what was there have gone: all keyframes have their turn first."""
    cloud, world = corridor(places)
    kept = np.random.default_rng(5).random(600) < 0.3
    cloud.positions = cloud.positions.copy()
    cloud.positions[:600][~kept] = (0.0, 0.0, -5.0)
    lost = Lost(world, last=0)
    found, frames = lost.found(cloud, np.eye(4))
    assert found is not None
    assert off(found, np.eye(4)) < 0.02
    assert found.matched < CONVINCING * lost.frames.usually_found(world, found)
    assert frames == len(world.keyframes) / TRIES
    after = lost.frames.track(world, View(CAMERA, found.features), np.eye(4), found, 25)
    assert after is not None
    assert after.matched >= 0.95 * found.matched, "it looks for what is seen there, not where it looked last"


def test_in_a_large_map_a_doubtful_place_is_waited_for_no_longer_than_that() -> None:
    cloud, world = corridor(places=25, alike=0.0)
    kept = np.random.default_rng(5).random(600) < 0.3
    cloud.positions = cloud.positions.copy()
    cloud.positions[:600][~kept] = (0.0, 0.0, -5.0)
    found, frames = Lost(world, last=0).found(cloud, np.eye(4))
    assert found is not None
    assert frames == pytest.approx(CONSIDERED_NS / FRAME_NS, abs=2.0)
    assert frames < len(world.keyframes) / TRIES


def test_a_place_that_convinced_and_does_so_no_more_is_doubtful_from_then_on() -> None:
    """Not since the camera was lost before, or for ever: the others have their turn first."""
    cloud, world = corridor(places=5)
    lost = Lost(world, last=0)
    assert lost.found(cloud, np.eye(4), most=1) == (None, 1)
    kept = np.random.default_rng(5).random(600) < 0.3
    cloud.positions = cloud.positions.copy()
    cloud.positions[:600][~kept] = (0.0, 0.0, -5.0)
    found, frames = lost.found(cloud, np.eye(4))
    assert found is not None
    assert frames == len(world.keyframes) / TRIES
