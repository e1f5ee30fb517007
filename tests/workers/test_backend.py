"""The backend worker fed with a cloud's keyframes: messages in, messages out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from prism_edge.config import Config, DepthConfig
from prism_edge.geometry.poses import inverse, transform
from prism_edge.messages import Acknowledged, Depth, EndOfStream, Gate, Keyframe, Scale, Tracked
from prism_edge.workers import backend as worker
from tests.backend.ring import Ring, position_error
from tests.backend.world import Teller
from tests.tracking.cloud import pose_at
from tests.workers.list_bus import ListBus

CONFIG = Config(depth=DepthConfig(model="exact"))
LOCKSTEP = replace(CONFIG, mode="lockstep")
NO_DEPTH = Config()
NAN = float("nan")


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    """What never comes is not waited for long."""
    monkeypatch.setattr(worker, "_DEPTH_WAIT_S", 0.02)
    monkeypatch.setattr(worker, "_PATIENCE_S", 0.1)
    monkeypatch.setattr(worker, "_LOOK_S", 0.005)


def keyframes(count: int, epoch: int = 0, first: int = 0) -> tuple[Teller, list[Keyframe]]:
    teller = Teller(epoch=epoch, noise_px=0.3, first=first)
    return teller, [teller.keyframe(pose_at(0.2 * i, 0.0, 0.0, 0.0, -0.03 * i)) for i in range(count)]


def depth_of(keyframe: Keyframe, teller: Teller, **changes: object) -> Depth:
    """A depth map in which each keypoint finds its own depth (each in a patch of its own, roughly)."""
    depth = np.full((120, 160), 3.0, np.float32)
    pose = teller.poses[keyframe.id - teller.first]
    local = transform(inverse(pose), teller.cloud.positions[keyframe.points])
    for (x, y), z in zip(np.rint(keyframe.pixels / 4).astype(int), local[:, 2], strict=True):
        depth[max(y - 1, 0) : y + 2, max(x - 1, 0) : x + 2] = z
    made = Depth(
        keyframe=keyframe.id,
        index=keyframe.index,
        stamp_ns=keyframe.stamp_ns,
        epoch=keyframe.epoch,
        model="exact",
        bias_sigma=0.0,
        inference_ms=1.0,
        valid=True,
        reason="",
        image_to_depth=np.array([0.25, 0.0, 0.25, 0.0]),
        depth=depth,
        confidence=np.zeros((0, 0), np.float32),
        descriptor=np.zeros(0, np.float32),
    )
    return replace(made, **changes)


def scale_of(keyframe: Keyframe, log_scale: float = 0.1, **changes: object) -> Scale:
    made = Scale(
        keyframe=keyframe.id,
        index=keyframe.index,
        stamp_ns=keyframe.stamp_ns,
        epoch=keyframe.epoch,
        log_scale=log_scale,
        sigma=0.1,
        filter_sigma=0.1,
        observation=log_scale,
        observation_sigma=0.1,
        points=50,
        accepted=True,
    )
    return replace(made, **changes)


def gate_of(keyframe: Keyframe, weight: float = 1.0) -> Gate:
    """Open, but for the second keypoint's ``weight``."""
    count = len(keyframe.pixels)
    weights = np.ones(count, np.float32)
    weights[1] = weight
    known = np.full(count, 0.3, np.float32)
    known[0] = np.nan
    return Gate(keyframe.id, keyframe.index, keyframe.epoch, weights, known)


def tick(index: int, keyframe: int = -1) -> Tracked:
    return Tracked(index, index * 33_000_000, 0, "ok", True, keyframe, 0, np.eye(4))


def snapshot(bus: ListBus):
    return bus.answers["map_snapshot"]()


def run_realtime(bus: ListBus, config: Config = CONFIG) -> None:
    worker.main(config, bus)


def test_each_keyframe_brings_a_correction():
    bus, (teller, told) = ListBus("keyframe"), keyframes(4)
    made = worker.BackendWorker(CONFIG, bus)
    for keyframe in told:
        bus.give("depth", depth_of(keyframe, teller))
        bus.give("gate", gate_of(keyframe))
        bus.give("log_scale", scale_of(keyframe))
        bus.give("keyframe", keyframe)
        made._realtime()
    updates = bus.of("map_update")
    assert [u.based_on for u in updates] == [1, 2, 3], "a single keyframe has nothing to solve"
    assert [u.sequence for u in updates] == [1, 2, 3]
    for k, pose in zip(updates[-1].keyframes.tolist(), updates[-1].poses, strict=True):
        assert np.linalg.norm((inverse(teller.poses[k]) @ pose)[:3, 3]) < 0.03
    assert bus.pulse.values["keyframes"] == "4"


def test_keyframes_that_came_together_are_solved_once():
    bus, (teller, told) = ListBus("keyframe"), keyframes(5)
    bus.give("depth", *(depth_of(k, teller) for k in told))
    bus.give("keyframe", *told)
    run_realtime(bus)
    updates = bus.of("map_update")
    assert [u.based_on for u in updates] == [4]
    assert snapshot(bus).keyframes.tolist() == [0, 1, 2, 3, 4]
    assert bus.states[0] == "ready"


def test_real_time_does_not_wait_for_depth_that_does_not_come():
    bus, (_, told) = ListBus("keyframe", patience=60), keyframes(3)
    bus.give("keyframe", *told)
    run_realtime(bus)
    assert bus.of("map_update")[-1].based_on == 2


def test_without_a_network_nothing_is_waited_for(monkeypatch):
    monkeypatch.setattr(worker, "_DEPTH_WAIT_S", 1e6)
    bus, (_, told) = ListBus("keyframe"), keyframes(3)
    bus.give("keyframe", *told)
    run_realtime(bus, NO_DEPTH)
    assert bus.of("map_update")[-1].based_on == 2


def test_ablating_the_depth_factor_uses_no_depth(monkeypatch):
    monkeypatch.setattr(worker, "_DEPTH_WAIT_S", 1e6)
    bus, (teller, told) = ListBus("keyframe"), keyframes(3)
    bus.give("depth", *(depth_of(k, teller) for k in told))
    bus.give("keyframe", *told)
    made = worker.BackendWorker(replace(CONFIG, ablate=("depth_factor",)), bus)
    made.run()
    assert bus.of("map_update")
    assert all(k.depths is None for k in made._mapper.world.keyframes.values())


@pytest.mark.parametrize(
    "changes",
    [
        {"depth": np.full((120, 160), NAN, np.float32)},
        {"depth": np.zeros((0, 0), np.float32)},
        {"image_to_depth": np.full(4, NAN)},
        {"valid": False},
        {"epoch": 4},
    ],
)
def test_depth_that_can_t_be_used_is_ignored(changes):
    bus, (teller, told) = ListBus("keyframe"), keyframes(4)
    bus.give("depth", *(depth_of(k, teller, **changes) for k in told))
    bus.give("keyframe", *told)
    made = worker.BackendWorker(CONFIG, bus)
    made.run()
    assert bus.of("map_update")[-1].based_on == 3
    for keyframe in made._mapper.world.keyframes.values():
        assert keyframe.depths is None or not keyframe.depths.any()


@pytest.mark.parametrize("changes", [{"log_scale": NAN}, {"log_scale": float("inf")}, {"epoch": 2}])
def test_a_scale_that_is_no_number_is_ignored(changes):
    bus, (teller, told) = ListBus("keyframe"), keyframes(3)
    bus.give("depth", *(depth_of(k, teller) for k in told))
    bus.give("log_scale", scale_of(told[0], 0.25), scale_of(told[1], **changes))
    bus.give("keyframe", *told)
    run_realtime(bus)
    assert snapshot(bus).log_scale == 0.25
    assert np.isfinite(bus.of("map_update")[-1].poses).all()


def test_the_snapshot_is_the_whole_map():
    bus, (teller, told) = ListBus("keyframe"), keyframes(4)
    empty = worker.BackendWorker(CONFIG, ListBus())._snapshot
    assert len(empty.keyframes) == len(empty.points) == 0
    bus.give("depth", *(depth_of(k, teller) for k in told))
    bus.give("keyframe", *told)
    run_realtime(bus)
    whole = snapshot(bus)
    assert whole.indices.tolist() == [0, 10, 20, 30]
    assert len(whole.points) == len(whole.positions) > 100
    for p, place in zip(whole.points.tolist(), whole.positions, strict=True):
        assert np.linalg.norm(place - teller.cloud.positions[p]) < 1.0
    assert not whole.settled


def test_the_end_settles_the_map_and_the_worker_stays():
    bus, (teller, told) = ListBus("keyframe", patience=40), keyframes(3)
    bus.give("depth", *(depth_of(k, teller) for k in told))
    bus.give("keyframe", *told)
    bus.give("end", EndOfStream(100, 100, 0, 0, 99))
    run_realtime(bus)
    assert snapshot(bus).settled
    assert bus.states.count("ended") == 1
    assert bus.of("map_update")


def test_a_new_map_begins_with_a_new_epoch():
    bus, (teller, old) = ListBus("keyframe"), keyframes(3)
    again, new = keyframes(3, epoch=1, first=3)
    bus.give("depth", *(depth_of(k, teller) for k in old))
    bus.give("gate", *(gate_of(k) for k in (*old, *new)))
    bus.give("keyframe", *old)
    made = worker.BackendWorker(CONFIG, bus)
    made._realtime()
    bus.give("depth", *(depth_of(k, again) for k in new))
    bus.give("keyframe", *new)
    made._realtime()
    bus.give("keyframe", old[-1])  # a straggler
    made._realtime()
    assert [(u.epoch, u.based_on) for u in bus.of("map_update")] == [(0, 2), (1, 5)]
    assert bus.of("map_update")[1].sequence > bus.of("map_update")[0].sequence
    assert made._snapshot.epoch == 1
    assert made._snapshot.keyframes.tolist() == [3, 4, 5]


def test_a_process_that_was_started_anew_numbers_on():
    bus, (teller, told) = ListBus("keyframe"), keyframes(3)
    bus.first_id = 1_000_000
    bus.give("depth", *(depth_of(k, teller) for k in told))
    bus.give("keyframe", *told)
    run_realtime(bus)
    assert bus.of("map_update")[0].sequence == 1_000_001


def lockstep(bus: ListBus, told: list[Keyframe], teller: Teller, with_scale: bool = True) -> None:
    """Four frames a keyframe, everything sent before the worker looks."""
    for keyframe in told:
        bus.give("keyframe", keyframe)
        bus.give("depth", depth_of(keyframe, teller))
        if with_scale:
            bus.give("log_scale", scale_of(keyframe))
    bus.give("tracked", *(tick(i, i // 4 if i % 4 == 0 else -1) for i in range(4 * len(told))))


def test_lockstep_acknowledges_every_frame_once_its_update_is_out():
    bus, (teller, told) = ListBus("tracked"), keyframes(4)
    lockstep(bus, told, teller)
    worker.main(LOCKSTEP, bus)
    assert bus.of("acknowledged") == [Acknowledged("backend", i) for i in range(16)]
    order = [(t, m.based_on if t == "map_update" else m.index) for t, m in bus.sent]
    for k in range(4):
        assert order.index(("map_update", k)) == order.index(("acknowledged", 4 * k)) - 1


def test_lockstep_answers_each_keyframe_even_with_nothing():
    """The tracker waits for one update a keyframe, in the order of the keyframes."""
    bus, (teller, told) = ListBus("tracked"), keyframes(4)
    lockstep(bus, told, teller)
    worker.main(LOCKSTEP, bus)
    updates = bus.of("map_update")
    assert [u.based_on for u in updates] == [0, 1, 2, 3]
    assert [u.sequence for u in updates] == [1, 2, 3, 4]
    assert len(updates[0].keyframes) == 0
    assert all(len(u.keyframes) for u in updates[1:])


def test_lockstep_waits_for_keyframe_depth_and_scale():
    """They come late, one at a time; the acknowledgement comes after the last of them."""
    teller, told = keyframes(2)
    bus = ListBus("tracked", patience=200)
    bus.give("tracked", tick(0, 0), tick(1, 1))
    late = {
        2: ("keyframe", told[0]),
        4: ("depth", depth_of(told[0], teller)),
        6: ("log_scale", scale_of(told[0])),
    }
    made = worker.BackendWorker(LOCKSTEP, bus)
    looks = 0
    receive = made._receive

    def count(timeout_s):
        nonlocal looks
        looks += 1
        if looks in late:
            assert not bus.of("acknowledged")
            bus.give(*late[looks])
        if looks == 7:
            bus.give("keyframe", told[1])
            bus.give("depth", depth_of(told[1], teller))
            bus.give("log_scale", scale_of(told[1]))
        receive(timeout_s)

    made._receive = count
    made.run()
    assert looks >= 6
    assert [a.index for a in bus.of("acknowledged")] == [0, 1]
    assert made._mapper.world.keyframes[0].depths is not None


def test_lockstep_goes_on_without_what_never_comes(caplog):
    teller, told = keyframes(3)
    bus = ListBus("tracked", patience=100)
    lockstep(bus, told, teller, with_scale=False)
    worker.main(LOCKSTEP, bus)
    assert [a.index for a in bus.of("acknowledged")] == list(range(12))
    assert [u.based_on for u in bus.of("map_update")] == [0, 1, 2]
    assert "keyframe 0 is incomplete" in caplog.text


def test_lockstep_needs_no_depth_where_there_is_no_network():
    _, told = keyframes(3)
    bus = ListBus("tracked")
    bus.give("keyframe", *told)
    bus.give("tracked", *(tick(i, i) for i in range(3)))
    worker.main(replace(NO_DEPTH, mode="lockstep"), bus)
    assert [u.based_on for u in bus.of("map_update")] == [0, 1, 2]
    assert len(bus.of("acknowledged")) == 3


def test_lockstep_twice_is_the_same_to_the_last_bit():
    runs = []
    for _ in range(2):
        bus, (teller, told) = ListBus("tracked"), keyframes(5)
        lockstep(bus, told, teller)
        worker.main(LOCKSTEP, bus)
        runs.append(bus.of("map_update"))
    for first, second in zip(*runs, strict=True):
        assert np.array_equal(first.poses, second.poses)
        assert np.array_equal(first.positions, second.positions)


def test_what_is_kept_for_later_does_not_grow():
    """Weeks of keyframes: depths that came early and scales are forgotten once their turn is over."""
    teller, told = keyframes(12)
    bus = ListBus("keyframe")
    made = worker.BackendWorker(CONFIG, bus)
    for keyframe in told:
        bus.give("depth", depth_of(keyframe, teller))
        bus.give("gate", gate_of(keyframe))
        bus.give("log_scale", scale_of(keyframe))
        bus.give("keyframe", keyframe)
        made._realtime()
    assert len(made._early) <= 1
    assert len(made._scaled) <= 1
    assert len(made._gated) <= 1
    assert not made._waiting


def ring_depth(keyframe: Keyframe, ring: Ring) -> Depth:
    """No depth worth the name, but what the network thinks the place looks like."""
    return Depth(
        keyframe=keyframe.id,
        index=keyframe.index,
        stamp_ns=keyframe.stamp_ns,
        epoch=keyframe.epoch,
        model="exact",
        bias_sigma=0.0,
        inference_ms=1.0,
        valid=False,
        reason="for its descriptor alone",
        image_to_depth=np.zeros(4),
        depth=np.zeros((0, 0), np.float32),
        confidence=np.zeros((0, 0), np.float32),
        descriptor=ring.looks_like(keyframe.id),
    )


def round_the_ring(bus: ListBus, config: Config, count: int = 43) -> Ring:
    ring = Ring(lap=36, drift=np.array([0.012, 0.006, -0.012, 0.002, -0.004, 0.002]), count=1800)
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
    closed = [u for u in updates if u.loop_closed]
    assert closed
    assert len(closed[0].fused_from) == len(closed[0].fused_into) > 20
    assert closed[0].keyframes.tolist() == list(range(closed[0].based_on + 1)), "everything moves"
    whole = snapshot(bus)
    assert whole.settled
    assert (whole.loop_queries - whole.loop_candidates > 300).all()
    assert whole.loop_queries[0] == 10 * closed[0].based_on
    assert (whole.loop_inliers >= 25).all()
    plain = ListBus("tracked", patience=40)
    round_the_ring(plain, replace(LOCKSTEP, ablate=("loop",)))
    assert not any(u.loop_closed for u in plain.of("map_update"))
    assert len(snapshot(plain).loop_queries) == 0
    with_loops, without = (
        position_error(dict(zip(s.keyframes.tolist(), s.poses, strict=True)), ring.true)
        for s in (whole, snapshot(plain))
    )
    assert with_loops < 0.5 * without


def test_the_end_waits_for_the_global_adjustment_of_the_last_loop():
    """In real time all of it comes at once here: one window, one loop, and then the adjustment's steps."""
    bus = ListBus("keyframe", patience=40)
    round_the_ring(bus, CONFIG)
    closed, adjusted = bus.of("map_update")
    assert closed.loop_closed
    assert not adjusted.loop_closed
    assert len(adjusted.keyframes) == 43
    assert bus.states.count("global adjustment") >= 2, "step by step"
    assert snapshot(bus).settled


@pytest.mark.parametrize("late", [False, True])
def test_the_gates_weights_reach_the_keyframe_before_or_after_it(late, monkeypatch):
    bus, (teller, told) = ListBus("keyframe"), keyframes(2)
    made = worker.BackendWorker(CONFIG, bus)
    bus.give("depth", depth_of(told[0], teller))
    if late:
        monkeypatch.setattr(worker, "_DEPTH_WAIT_S", 0.0)
    else:
        bus.give("gate", gate_of(told[0], 0.25))
    bus.give("keyframe", told[0])
    made._realtime()
    if late:
        bus.give("gate", gate_of(told[0], 0.25))
        made._realtime()
    keyframe = made._mapper.world.keyframes[0]
    assert keyframe.gate_weight(1) == 0.25
    assert keyframe.gate_weight(0) == 1.0, "nothing is known of it"


def test_a_gate_that_does_not_fit_its_keyframe_is_passed_over():
    bus, (teller, told) = ListBus("keyframe"), keyframes(2)
    made = worker.BackendWorker(CONFIG, bus)
    bus.give("depth", depth_of(told[0], teller))
    short = gate_of(told[0], 0.25)
    bus.give("gate", replace(short, weights=short.weights[:5]), replace(short, epoch=7))
    bus.give("keyframe", told[0])
    made._realtime()
    assert made._mapper.world.keyframes[0].weights is None
