"""What a keyframe adds to a map: against plain counts over the observations."""

from __future__ import annotations

import numpy as np
import pytest

from prism_edge.tracking.keyframe_culling import drop_keyframe
from prism_edge.tracking.local_map import LocalMap
from prism_edge.tracking.redundancy import bridged, redundancy
from tests.tracking.cloud import counted, observations, walk


def test_redundancy_is_the_share_of_points_that_three_others_see():
    world = walk(12, 0.3)
    shares = {k: redundancy(world, keyframe) for k, keyframe in world.keyframes.items()}
    assert shares == pytest.approx({k: counted(world, k) for k in world.keyframes})
    assert min(shares.values()) < 0.9 < max(shares.values())


def test_what_sees_nothing_is_all_redundant():
    world = walk(5)
    world.keyframes[2].points[:] = -1
    assert redundancy(world, world.keyframes[2]) == 1.0


@pytest.mark.parametrize("step", [0.1, 0.4, 1.0])
def test_what_an_older_and_a_newer_one_see_is_bridged(step):
    world = walk(20, step)
    for gone in (5, 6, 9, 13):
        drop_keyframe(world, world.keyframes[gone])
    world.drop_observations(np.full(200, 7), world.points.ids[:200])
    world.keyframes[3].points[:] = -1
    found = bridged(world)
    assert found.pop(3) == 1.0
    views = observations(world).values()
    for k, share in found.items():
        mine = [viewers for viewers in views if k in viewers]
        both = sum(min(viewers) < k < max(viewers) for viewers in mine)
        assert share == (pytest.approx(both / len(mine)) if mine else 1.0)
    assert len(set(found.values())) > 3


def test_a_map_of_nothing_has_nothing_to_bridge():
    assert bridged(LocalMap()) == {}
