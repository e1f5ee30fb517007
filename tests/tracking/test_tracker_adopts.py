"""A map that was there before: what a tracker takes over of it besides points."""

from __future__ import annotations

import numpy as np
import pytest

from prism_edge.messages import beyond
from prism_edge.tracking.place_index import PlaceIndex
from prism_edge.tracking.submaps import Parts
from prism_edge.tracking.tracker import Tracker
from tests.tracking.cloud import CAMERA, Cloud, pose_at
from tests.tracking.film_run import CONFIG

IMAGE = np.random.default_rng(0).integers(0, 256, (480, 640), np.uint8)  # full of corners
STEP_NS = 100_000_000


@pytest.fixture
def adopted() -> Tracker:
    """Its map is of half a metre a unit, and of a camera whose lens was found to bend."""
    world, _ = Cloud(200).mapped([pose_at(0.1 * i) for i in range(3)])
    for keyframe in world.keyframes.values():
        keyframe.camera = CAMERA.bent(-0.05)
    tracker = Tracker(CONFIG)
    tracker.adopt(world, PlaceIndex(), Parts(), 7, np.log(0.5))
    return tracker


def test_its_unit_is_what_is_published_and_what_depth_is_brought_into(adopted: Tracker) -> None:
    assert adopted.epoch == 7
    assert adopted.log_scale == adopted.map_log_scale == np.log(0.5)


def test_its_lens_is_what_images_are_seen_through(adopted: Tracker, monkeypatch) -> None:
    """The camera file says nothing of it, and an hour of mapping did."""
    seen, extract = [], adopted._extractor.extract
    monkeypatch.setattr(
        adopted._extractor, "extract", lambda grey, lens: seen.append(lens) or extract(grey, lens)
    )
    adopted.process(0, STEP_NS, IMAGE, CAMERA)
    assert seen == [CAMERA.bent(-0.05)]
    adopted.reset()
    adopted.process(1, 2 * STEP_NS, IMAGE, CAMERA)
    assert seen[1] == CAMERA


def test_its_keyframes_are_known_to_the_backend_and_new_ones_numbered_beyond_them(adopted: Tracker) -> None:
    assert adopted.world.announced == 2
    adopted.reset()
    adopted.process(0, STEP_NS, IMAGE, CAMERA)
    keyframe = adopted.maybe_keyframe()
    assert keyframe is not None
    assert keyframe.id >= beyond(2)
