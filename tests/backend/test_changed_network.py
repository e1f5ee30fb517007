"""A map's keyframes have the metres of one network: of the one that speaks now."""

from __future__ import annotations

from prism_edge.backend.mapper import Mapper
from tests.backend.test_mapper import CONFIG, WIDE, plane
from tests.backend.world import Teller, told_depth
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

    def hear(number: int, network: str) -> None:
        mapper.add_depth(told[number], told_depth(plane(3.0), WIDE, float("nan"), network), 0.0)

    hear(0, "one")
    hear(1, "")
    hear(2, "one")
    assert units() == [True, True, True, False, False]
    hear(3, "")
    hear(4, "another")
    assert units() == [False, False, False, False, True]


def test_a_map_that_was_taken_up_has_the_metres_of_the_network_that_it_was_made_with():
    """After a restart, too: what the other network said of keyframes' sizes is forgotten with its first."""
    made, teller = Mapper(CONFIG), Teller()
    for message in (teller.keyframe(pose_at(0.2 * i)) for i in range(3)):
        made.absorb(message)
        message.depths[:] = 3.0
        made.add_depth(message, told_depth(plane(3.0), WIDE, float("nan"), "one"), 0.0)
    info, arrays = made.stored(in_use=True)
    for network, forgotten in (("one", False), ("another", True)):
        mapper = Mapper(CONFIG)
        mapper.restore({**info, "log_scale": 0.0, "scale_sigma": 0.1, "scale_by": "one"}, arrays)
        mapper.add_late_depth(told_depth(plane(3.0), WIDE, float("nan"), network, 2), 0.0)
        assert [mapper.world.keyframes[k].depth_units == 0.0 for k in (0, 1)] == [forgotten] * 2
