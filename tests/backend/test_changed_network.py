"""A map's keyframes have the metres of one network: of the one that speaks now."""

from __future__ import annotations

from prism_edge.backend.mapper import Mapper
from tests.backend.test_mapper import CONFIG, WIDE, plane
from tests.backend.world import Teller
from tests.tracking.cloud import pose_at


def test_of_two_networks_the_later_one_s_metres_count():
    """Sizes that the one before gave to keyframes are forgotten; depth that is nobody's changes nothing."""
    mapper, teller = Mapper(CONFIG), Teller()
    told = [teller.keyframe(pose_at(0.2 * i)) for i in range(5)]
    for message in told:
        mapper.absorb(message)
        message.depths[:] = 3.0

    def units() -> list[bool]:
        return [mapper.world.keyframes[k].depth_units > 0 for k in range(5)]

    hear = [(m, plane(3.0), WIDE, 0.0, float("nan")) for m in told]
    mapper.add_depth(*hear[0], "one")
    mapper.add_depth(*hear[1], "")
    mapper.add_depth(*hear[2], "one")
    assert units() == [True, True, True, False, False]
    mapper.add_depth(*hear[3], "")
    mapper.add_depth(*hear[4], "another")
    assert units() == [False, False, False, False, True]
