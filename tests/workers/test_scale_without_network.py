"""The scale worker in a run without a depth network: a loaded map's metres, or none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from prism_edge.messages import MapLoaded
from prism_edge.workers import scale as worker
from tests.scale.scene import keyframe_of_wall
from tests.synthetic.messages import tick
from tests.workers.test_scale import SCALE, bus, start

__all__ = ["bus", "start"]  # fixtures


def test_without_a_loaded_map_nothing_is_said_of_metres(bus, start):
    bus.give("keyframe", *(keyframe_of_wall(k, 0.4 * k) for k in range(2)))
    bus.give("tracked", tick(0, keyframe=0), tick(1, keyframe=1))
    start("lockstep", model="")
    bus.wait_for("acknowledged", 2)
    assert len(bus.of("log_scale")) == 2, "for which others wait"
    assert bus.of("scale") == []


@pytest.mark.parametrize("mode", ["realtime", "lockstep"])
def test_a_loaded_map_s_metres_get_less_sure_with_all_that_is_built_on_it(bus, start, mode, monkeypatch):
    monkeypatch.setattr(worker, "_SILENT_S", -1.0)  # nobody waits for depth, however long none has come
    bus.give("map_loaded", MapLoaded(0, np.log(1.3), 0.03, 0.1))
    keyframes = [replace(keyframe_of_wall(k, 4.0 * k), travelled=4.0 * k) for k in range(4)]
    bus.give("keyframe", *keyframes[:3])
    bus.give("tracked", *(tick(k, keyframe=k) for k in range(3)))
    start(mode, model="", scale=replace(SCALE, drift_per_sqrt_m=0.1, drift_per_sqrt_s=0.0))
    bus.wait_for("scale", 4)
    bus.give("keyframe", keyframes[3])
    bus.give("tracked", tick(3, keyframe=3))
    bus.wait_for("scale", 5)
    said = bus.of("scale")
    assert [message.keyframe for message in said] == [-1, 0, 1, 2, 3]
    assert all(message.scale == pytest.approx(1.3) and message.metric for message in said)
    grown = [message.filter_sigma_log**2 - 0.03**2 for message in said]
    a_metre = 0.1**2 * 1.3
    assert grown == pytest.approx([0.0, 0.0, 4.0 * a_metre, 8.0 * a_metre, 12.0 * a_metre], abs=1e-6)
