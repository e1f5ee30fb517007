"""A keyframe that was on its way while a rolling shutter was found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from prism_edge.backend.global_map import GlobalMap
from prism_edge.backend.rows_at_once import message_at_once
from prism_edge.geometry.cameras import Camera
from prism_edge.messages import Keyframe
from prism_edge.tracking.rolling_shutter import seen_at_once
from tests.backend.world import Teller
from tests.tracking.cloud import CAMERA, pose_at

TWIST = np.array([0.2, 0.1, 0.0, 0.1, 0.4, -0.1])


@pytest.fixture
def told() -> Keyframe:
    return replace(Teller().keyframe(pose_at(0.1)), twist=TWIST)


def test_it_is_moved_by_what_it_does_not_know(told):
    before = replace(told, readout_ms=10.0)
    moved = message_at_once(before, 26.0)
    camera = Camera.from_array(told.camera_model, told.camera)
    depth = float(np.median(told.depths[told.depths > 0]))
    true = seen_at_once(told.pixels.astype(float), camera, TWIST, depth, 16.0)
    assert moved.readout_ms == 26.0
    np.testing.assert_allclose(moved.pixels, true, atol=1e-3)
    assert moved.pixels.dtype == np.float32
    assert np.abs(moved.pixels - told.pixels).max() > 0.5


def test_what_knows_it_or_a_readout_that_is_said_is_left_alone(told):
    assert message_at_once(replace(told, readout_ms=26.0), 26.0).pixels is told.pixels
    said = replace(told, readout_ms=5.0, readout_said=True)
    assert message_at_once(said, 26.0) is said


@pytest.mark.parametrize(("lacks", "has"), [("twist", 0.0), ("twist", np.nan), ("depths", 0.0)])
def test_without_a_motion_or_a_depth_its_pixels_stay(told, lacks, has):
    moved = message_at_once(replace(told, **{lacks: np.full_like(getattr(told, lacks), has)}), 26.0)
    assert moved.readout_ms == 26.0
    assert np.array_equal(moved.pixels, told.pixels)


def test_a_map_takes_keyframes_in_by_the_readout_that_it_has_found(told):
    world = GlobalMap()
    world.absorb(replace(told, id=told.id + 1))
    world.readout_ms = 26.0
    added = world.absorb(told)
    np.testing.assert_allclose(added.pixels, message_at_once(told, 26.0).pixels)
    np.testing.assert_allclose(added.features.pixels, added.pixels)
    assert not world.readout_said
    world.absorb(replace(told, id=told.id + 2, readout_said=True))
    world.absorb(replace(told, id=told.id + 3))
    assert world.readout_said, "said once is said"


@pytest.mark.parametrize(("said", "known"), [(False, 26.0), (True, 0.0)])
def test_a_map_begins_with_what_one_before_it_has_shown(told, said, known):
    world = GlobalMap()
    added = world.absorb(replace(told, readout_ms=26.0, readout_said=said))
    assert world.readout_ms == known
    assert np.array_equal(added.pixels, told.pixels)
    later = world.absorb(replace(told, id=told.id + 1, readout_ms=0.0, readout_said=said))
    assert np.array_equal(later.pixels, told.pixels) == said


def test_another_camera_s_rows_are_not_read_as_slowly_as_those_of_who_made_the_map(told):
    world, other = GlobalMap(), replace(CAMERA, fx=1.5 * CAMERA.fx, fy=1.5 * CAMERA.fy)
    world.absorb(told)
    world.readout_ms = 26.0
    for number in (1, 2):  # also once it has made keyframes itself
        swapped = replace(told, id=told.id + number, camera=other.to_array(), camera_model=other.model)
        assert np.array_equal(world.absorb(swapped).pixels, told.pixels)
    its_own = world.absorb(replace(told, id=told.id + 3, camera=CAMERA.bent(0.01).to_array()))
    assert not np.allclose(its_own.pixels, told.pixels, atol=0.5)
