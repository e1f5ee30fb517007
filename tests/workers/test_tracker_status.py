"""What `status` says of a map whose metres are doubtful, and of the next one."""

from __future__ import annotations

from types import SimpleNamespace

from prism_edge.messages import DEGRADED, OK
from prism_edge.workers.tracker_status import TrackerStatus


def test_a_new_map_is_not_degraded_for_the_metres_of_the_one_before():
    bus = SimpleNamespace(publish=lambda topic, message: None, pulse=SimpleNamespace(values={}))
    status = TrackerStatus(bus)

    def said(epoch: int, stamp_ns: int) -> tuple[str, str]:
        status.show(epoch, OK, True, False, stamp_ns, {})
        return bus.pulse.values["odometry"], bus.pulse.values["depth"]

    assert said(0, 0) == (OK, "ok")
    for keyframe in range(5):
        status.metres.scale(keyframe, 0.8, accepted=False)
    assert said(0, 10**9) == (DEGRADED, "depth contradicts the scale")
    assert said(1, 2 * 10**9) == (OK, "ok")
    status.metres.depth(7, False, "dark")
    assert said(1, 3 * 10**9) == (DEGRADED, "no usable depth: dark")


def test_a_map_that_stays_as_it_is_is_not_degraded_for_depth_that_never_came():
    bus = SimpleNamespace(publish=lambda topic, message: None, pulse=SimpleNamespace(values={}))
    status = TrackerStatus(bus)
    status.show(0, OK, True, False, 0, {})
    status.metres.keyframe(3, 0)
    status.show(0, OK, True, False, 6 * 10**9, {})
    assert bus.pulse.values["odometry"] == DEGRADED
    status.show(0, OK, True, True, 7 * 10**9, {})
    assert bus.pulse.values["odometry"] == OK
