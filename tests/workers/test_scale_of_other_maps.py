"""The scale worker where one map takes another's place: loaded, or begun on command."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from prism_edge.messages import Epoch, MapLoaded
from tests.scale.scene import depth_of, keyframe_of_wall
from tests.workers.test_scale import bus, start

__all__ = ["bus", "start"]  # fixtures


@pytest.mark.parametrize("mode", ["realtime", "lockstep"])
def test_a_loaded_map_s_scale_is_said_at_once(bus, start, mode):
    """A map that is only localised in makes no keyframes, whose scales would say it."""
    bus.give("map_loaded", MapLoaded(1000, np.log(1.3), 0.03, 0.1, lost_sigma=2.0))
    start(mode)
    bus.wait_for("scale", 1)
    (said,) = bus.of("scale")
    assert said.scale == pytest.approx(1.3)
    whole = pytest.approx(np.linalg.norm([0.03, 0.1, 2.0]))
    assert (said.sigma_log, said.filter_sigma_log) == (whole, 0.03)
    assert said.metric
    assert said.keyframe == -1


@pytest.mark.parametrize(("lost_sigma", "warned"), [(0.0, ""), (2.0, "worth little")])
def test_health_shows_a_loaded_map_s_metres_and_what_is_doubtful_about_them(bus, start, lost_sigma, warned):
    bus.pulse.values.update(log_scale="0.9000", sigma="0.5000")
    bus.pulse.warn("metres", "the map before")
    bus.give("map_loaded", MapLoaded(1000, np.log(1.3), 0.03, 0.04, lost_sigma=lost_sigma))
    start()
    bus.wait_for("scale", 1)
    assert bus.pulse.values["log_scale"] == "0.2624"
    assert bus.pulse.values["sigma"] == f"{np.hypot(0.05, lost_sigma):.4f}"
    assert warned in bus.pulse.values["warning"] if warned else "warning" not in bus.pulse.values


def test_health_shows_no_metres_of_a_loaded_map_that_has_none(bus, start):
    bus.pulse.values.update(log_scale="0.9000", sigma="0.5000")
    bus.pulse.warn("metres", "the map before")
    bus.give("map_loaded", MapLoaded(3, 0.0, 0.3, metric=False))
    start()
    bus.wait_for("scale", 1)
    assert not bus.pulse.values.keys() & {"log_scale", "sigma", "warning"}


def test_a_map_of_whose_unit_nothing_is_known_is_not_said_to_be_metric(bus, start):
    bus.give("map_loaded", MapLoaded(3, 0.0, 0.3, metric=False))
    start()
    bus.wait_for("scale", 1)
    assert not bus.of("scale")[0].metric
    keyframe = keyframe_of_wall(7, 2.0, epoch=3)
    bus.give("depth", replace(depth_of(keyframe), valid=False, reason="constant"))
    bus.give("keyframe", keyframe)  # after it: a keyframe whose depth is long in coming is answered without
    bus.wait_for("scale", 2)
    assert not bus.of("scale")[1].metric
    (said,) = bus.of("log_scale")
    assert (said.epoch, said.metric) == (3, False)


def test_a_map_that_was_given_up_leaves_no_metres_behind(bus, start):
    """Who asks for `scale` after a `reset` is not told that of the map before."""
    bus.give("map_loaded", MapLoaded(3, np.log(1.3), 0.03, 0.1))
    start()
    bus.wait_for("scale", 1)
    bus.pulse.values.update(log_scale="0.26", sigma="0.03")
    bus.pulse.warn("metres", "that network is lost")
    bus.give("new_map", Epoch(3), Epoch(4), Epoch(2))  # late, and twice over
    bus.wait_for("scale", 2)
    bus.give("map_loaded", MapLoaded(3, np.log(1.3), 0.03, 0.1))  # loaded before that, heard of after
    assert not {"log_scale", "sigma", "warning"} & bus.pulse.values.keys()
    said = bus.of("scale")[1]
    assert (said.scale, said.sigma_log, said.metric, said.keyframe) == (1.0, 0.3, False, -1)
    old, new = (keyframe_of_wall(7, 2.0, epoch=epoch) for epoch in (3, 4))
    bus.give("depth", depth_of(old), depth_of(new))
    bus.give("keyframe", old, new)
    bus.wait_for("scale", 3)
    assert [said.epoch for said in bus.of("log_scale")] == [4]
    assert len(bus.of("scale")) == 3


def test_where_no_metres_were_said_none_are_taken_back(bus, start):
    bus.give("new_map", Epoch(1))
    start()
    keyframe = keyframe_of_wall(7, 2.0, epoch=1)
    bus.give("depth", depth_of(keyframe))
    bus.give("keyframe", keyframe)
    bus.wait_for("scale", 1)
    assert [said.keyframe for said in bus.of("scale")] == [7]
