"""Depth that comes once its keyframe has been solved is held against the map as it is by then."""

from __future__ import annotations

import math

import numpy as np
import pytest

from prism_edge.backend.mapper import LEAST_DEPTH_SIGMA, Mapper
from prism_edge.config import BackendConfig
from tests.backend.test_measured_depth import WIDE, true_depth
from tests.backend.world import Teller, told_depth
from tests.tracking.cloud import pose_at

FACTOR = 1.3  # by which a loop has stretched the map meanwhile
NETWORK = 0.8  # of the true depth, as this one sees it


@pytest.fixture
def walked() -> tuple[Mapper, Teller, list]:
    """A map that has been solved without depth, and then stretched."""
    mapper, teller = Mapper(BackendConfig(observations=300)), Teller()
    told = [teller.keyframe(pose_at(0.2 * i)) for i in range(4)]
    for keyframe in told:
        mapper.absorb(keyframe)
        mapper.optimise(keyframe.id, 0.0)
    for k in mapper.world.keyframes.values():
        k.world_from_camera = k.world_from_camera.copy()
        k.world_from_camera[:3, 3] *= FACTOR
    for point in mapper.world.points.values():
        point.position = FACTOR * point.position
    return mapper, teller, told


def late(mapper: Mapper, teller: Teller, keyframe, frame_sigma: float) -> np.ndarray:
    """What each of its keypoints has for a depth then, over the true one; nan for none."""
    depth = NETWORK * true_depth(teller, keyframe)
    mapper.add_late_depth(told_depth(depth, WIDE, frame_sigma, "", keyframe.id), 0.0)
    found = mapper.world.keyframes[keyframe.id].depths
    assert found is not None
    return np.where(found > 0, found / keyframe.depths, np.nan)


def test_a_network_s_takes_the_scale_that_the_keyframe_s_points_have_by_now(walked):
    ratios = late(*walked[:2], walked[2][2], float("nan"))
    assert np.nanmedian(ratios) == pytest.approx(FACTOR, rel=0.02)
    assert walked[0].world.keyframes[2].depth_sigma == 0.0


def test_it_is_no_matter_how_the_keyframe_lies_in_the_map_by_then(walked):
    """Depth is along its own axis: a map that a loop has turned round has its points elsewhere in z."""
    mapper, teller, told = walked
    mapper.world.move(pose_at(0.5, -0.3, 4.0, 0.2, 1.0), set(mapper.world.keyframes))
    ratios = late(mapper, teller, told[2], math.nan)
    assert np.nanmedian(ratios) == pytest.approx(FACTOR, rel=0.02)


def test_a_sensor_s_takes_the_map_s_own_scale(walked):
    ratios = late(*walked[:2], walked[2][2], 0.0)
    assert np.nanmedian(ratios) == pytest.approx(NETWORK, rel=0.02)
    assert walked[0].world.keyframes[2].depth_sigma == LEAST_DEPTH_SIGMA


def test_it_is_no_matter_where_the_keyframe_sees_nothing_or_is_gone(walked):
    mapper, teller, told = walked
    for p in list(mapper.world.keyframes[3].observed):
        mapper.world.drop_observation(3, p)
    mapper.add_late_depth(told_depth(true_depth(teller, told[3]), WIDE, math.nan, "", 3), np.log(2.0))
    depths = mapper.world.keyframes[3].depths
    assert depths is not None
    assert np.nanmedian(depths / told[3].depths) == pytest.approx(0.5, rel=0.02)
    mapper.add_late_depth(told_depth(true_depth(teller, told[3]), WIDE, math.nan, "", 99), 0.0)
    assert 99 not in mapper.world.keyframes
