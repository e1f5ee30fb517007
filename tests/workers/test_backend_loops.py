"""The backend worker on a walk round a ring: loops found, announced, and adjusted before the end."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import replace

import numpy as np
import pytest

from prism_edge.backend.loop_closing import Accepted
from prism_edge.config import Config
from prism_edge.messages import HOME, Depth, EndOfStream, Keyframe
from prism_edge.workers import arrivals
from prism_edge.workers import backend as worker
from tests.backend.ring import Ring, position_error
from tests.synthetic.messages import depth_of, tick
from tests.workers.backend_bench import CONFIG, LOCKSTEP, gate_of, hear, keyframes, scale_of, snapshot
from tests.workers.list_bus import ListBus

pytestmark = pytest.mark.usefixtures("impatient")


def ring_depth(keyframe: Keyframe, ring: Ring) -> Depth:
    """No depth worth the name, but what the network thinks the place looks like."""
    said = {"valid": False, "reason": "for its descriptor alone", "descriptor": ring.looks_like(keyframe.id)}
    return depth_of(keyframe, np.zeros((0, 0), np.float32), np.zeros(4), **said)


def round_the_ring(bus: ListBus, config: Config, count: int = 43) -> Ring:
    drift = np.array([0.012, 0.006, -0.012, 0.002, -0.004, 0.002])
    ring = Ring(lap=36, drift=drift, count=1800, seed=1)
    for i in range(count):
        keyframe = ring.keyframe()
        bus.give("keyframe", keyframe)
        bus.give("depth", ring_depth(keyframe, ring))
        bus.give("gate", gate_of(keyframe))
        bus.give("log_scale", scale_of(keyframe, 0.0))
        bus.give("tracked", tick(i, keyframe.id))
    bus.give("end", EndOfStream(count, count, 0, 0, count - 1))
    worker.main(config, bus)
    return ring


def test_a_loop_is_announced_with_its_keyframe_s_update_and_stands_in_the_snapshot():
    bus = ListBus("tracked", patience=40)
    ring = round_the_ring(bus, LOCKSTEP)
    updates = bus.of("map_update")
    assert [u.based_on for u in updates if u.based_on < 43][:43] == list(range(43)), "one for each keyframe"
    closed = [u for u in updates if u.loop_query >= 0]
    assert closed
    assert len(closed[0].fused_from) == len(closed[0].fused_into) > 20
    assert closed[0].keyframes.tolist() == list(range(closed[0].based_on + 1)), "everything moves"
    whole = snapshot(bus)
    assert whole.settled
    assert (whole.loop_queries - whole.loop_candidates > 300).all()
    assert whole.loop_queries[0] == 10 * closed[0].based_on
    assert (whole.loop_inliers >= 30).all()
    plain = ListBus("tracked", patience=40)
    round_the_ring(plain, replace(LOCKSTEP, ablate=("loop",)))
    assert not any(u.loop_query >= 0 for u in plain.of("map_update"))
    assert len(snapshot(plain).loop_queries) == 0
    with_loops, without = (
        position_error(dict(zip(s.keyframes.tolist(), s.poses, strict=True)), ring.true)
        for s in (whole, snapshot(plain))
    )
    assert with_loops < 0.5 * without


def late_ring(lag: int, count: int = 43) -> tuple[ListBus, worker.BackendWorker]:
    """Real time with a slow network: depth comes once its keyframe, and ``lag`` more, have been solved."""
    bus = ListBus("keyframe", patience=40)
    made = worker.BackendWorker(CONFIG, bus)
    drift = np.array([0.012, 0.006, -0.012, 0.002, -0.004, 0.002])
    ring = Ring(lap=36, drift=drift, count=1800, seed=1)
    under_way: deque[Keyframe] = deque()
    for _ in range(count):
        keyframe = ring.keyframe()
        under_way.append(keyframe)
        bus.give("keyframe", keyframe)
        while keyframe.id not in made._mapper.world.keyframes:
            made._realtime()
        if len(under_way) > lag:
            bus.give("depth", ring_depth(under_way.popleft(), ring))
            made._realtime()
    bus.give("depth", *(ring_depth(keyframe, ring) for keyframe in under_way))
    return bus, made


@pytest.mark.parametrize("lag", [0, 3])
def test_a_place_is_recognised_by_a_descriptor_that_comes_late(lag, monkeypatch):
    monkeypatch.setattr(arrivals, "DEPTH_WAIT_S", 0.0)
    bus, made = late_ring(lag)
    loops, updates = made._mapper.loops, bus.of("map_update")
    assert loops.accepted
    closed = next(u for u in updates if u.loop_query >= 0)
    assert closed.based_on == closed.loop_query + lag
    assert closed.loop_query - closed.loop_candidate > 30
    assert closed.keyframes.tolist() == list(range(closed.based_on + 1)), "everything moves"
    assert len(closed.fused_from) > 20
    assert len(snapshot(bus).loop_queries) == len(loops.accepted)
    assert loops._count == 43, "a second look is none of another keyframe"
    assert loops._now_ns == made._mapper.world.keyframes[42].stamp_ns


def test_the_end_waits_for_a_look_at_a_place_that_came_late(monkeypatch):
    monkeypatch.setattr(arrivals, "DEPTH_WAIT_S", 0.0)
    bus, made = late_ring(42, count=43)
    assert not made._mapper.loops.accepted
    bus.give("end", EndOfStream(43, 43, 0, 0, 42))
    made.run()
    assert bus.states.count("ended") == 1
    assert made._mapper.loops.accepted
    assert bus.states.index("place of keyframe 42") < bus.states.index("global adjustment")
    assert snapshot(bus).settled


def test_the_end_waits_for_the_global_adjustment_of_the_last_loop():
    """In real time all of it comes at once here: one window, one loop, and then the adjustment's steps."""
    bus = ListBus("keyframe", patience=40)
    round_the_ring(bus, CONFIG)
    closed, adjusted = bus.of("map_update")
    assert closed.loop_query >= 0
    assert adjusted.loop_query == -1
    assert len(adjusted.keyframes) == 43
    assert bus.states.count("global adjustment") >= 2, "step by step"
    steps = [i for i, state in enumerate(bus.states) if state == "global adjustment"]
    assert {bus.states[i + 1] for i in steps} <= {"idle", "ended"}, "else the watchdog counts on"
    assert bus.of("map_loaded") == [], "it is the run's own map"
    assert snapshot(bus).settled


def test_windows_go_by_the_unit_that_a_part_has_since_it_was_joined(monkeypatch):
    """What is told of it before the tracker has heard of the loop is of a unit that is no more."""
    bus, (teller, told) = ListBus("keyframe"), keyframes(5)
    made = worker.BackendWorker(CONFIG, bus)
    asked, loops, optimise = [], made._mapper.loops, made._mapper.optimise
    monkeypatch.setattr(made._mapper, "optimise", lambda k, units: asked.append(units) or optimise(k, units))
    hear(made, bus, told[:2], teller, log_scale=0.25)
    part = told[2].id
    for keyframe in told[2:4]:
        bus.give("log_scale", scale_of(keyframe, 0.9, part=part))
        hear(made, bus, [replace(keyframe, part=part)], teller, log_scale=math.nan)
    assert asked[2:] == [0.9, 0.9]
    joining = Accepted(told[3].id, told[0].id, 30, 0, np.eye(4), 50, units=(0.65, 0.05))
    known = []
    monkeypatch.setattr(loops, "look", lambda k, between: known.append(between(part, HOME)) or joining)
    made._look(told[3].id)
    assert known[0][0] == pytest.approx(0.65)
    bus.give("log_scale", scale_of(told[4], 0.95, part=part))
    hear(made, bus, [replace(told[4], part=part)], teller, log_scale=math.nan)
    assert asked[4:] == [0.25]
