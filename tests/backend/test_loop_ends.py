"""What the two ends of a loop have to say, and what of it is heard."""

from __future__ import annotations

import numpy as np
import pytest

from prism_edge.backend import loops
from prism_edge.backend.global_map import GlobalMap
from prism_edge.backend.loops import GUIDED_RADII, Surroundings
from tests.backend.world import Teller
from tests.tracking.cloud import pose_at


@pytest.fixture
def world() -> GlobalMap:
    teller, world = Teller(), GlobalMap()
    for i in range(4):
        world.absorb(teller.keyframe(pose_at(0.1 * i)))
    return world


def test_points_that_both_ends_have_in_common_measure_no_ratio_of_their_units(world: GlobalMap) -> None:
    """They are as far by the one as by the other, whatever the units: nobody may be sure of that."""
    here = world.keyframes[3]
    pairs = [(keypoint, point) for point, keypoint in here.observed.items()]
    places = np.array([world.points[point].position for _, point in pairs])
    assert len(pairs) > 50
    assert loops._unit_ratio(world, here, here.world_from_camera, pairs, places) == (1.0, 0.2)


def test_nothing_is_expected_in_the_image_of_a_camera_that_looks_the_other_way(world: GlobalMap) -> None:
    here, there = world.keyframes[3], world.keyframes[0]
    assert loops._expected(world, here, there) > 50
    here.world_from_camera = here.world_from_camera @ pose_at(0.0, 0.0, 0.0, 0.0, np.pi)
    assert loops._expected(world, here, there) == 0


def test_keypoints_that_do_not_fit_the_place_show_none_of_its_points(world: GlobalMap) -> None:
    """They look alike but are not as the view is placed: they join nothing."""
    view = world.keyframes[3]
    off = np.array(sorted(view.observed.values()))[::8]
    view.pixels = view.pixels.copy()
    view.pixels[off] += 60.0
    found = Surroundings(world, 0, without=3).look(view, view.world_from_camera, GUIDED_RADII)
    assert found is not None
    assert len(found.keypoints) == len(found.points) > 50
    assert not np.isin(off, found.keypoints).any()
