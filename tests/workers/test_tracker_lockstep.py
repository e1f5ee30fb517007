"""The tracker worker in lockstep, and started anew."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from prism_edge.messages import (
    IDS_A_LIFE,
    Acknowledged,
)
from prism_edge.workers import answers_due
from tests.workers.list_bus import ListBus
from tests.workers.test_tracker_commands import when_frames_left
from tests.workers.tracker_bench import (
    LOCKSTEP,
    World,
    depth_of,
    frame,
    positions,
    run,
    true_position,
    update_of,
)


def test_lockstep_acknowledges_every_frame_after_its_work(bus, world):
    run(bus, [frame(i) for i in range(20)], LOCKSTEP)
    assert bus.of("acknowledged") == [Acknowledged("tracker", i) for i in range(20)]
    for i in range(20):
        order = [(t, m.index) for t, m in bus.sent if t in ("keyframe", "tracked", "acknowledged")]
        assert order.index(("tracked", i)) < order.index(("acknowledged", i))
    for keyframe in bus.of("keyframe"):
        told = [order.index((t, keyframe.index)) for t in ("tracked", "keyframe", "acknowledged")]
        assert told == sorted(told)


def test_lockstep_holds_depth_back_for_its_lag(bus, world):
    config = replace(LOCKSTEP, lockstep=replace(LOCKSTEP.lockstep, depth_lag=4))
    run(bus, [frame(i) for i in range(10)], config)
    assert [t.index for t in bus.of("tracked") if t.published] == list(range(4, 10))


def test_lockstep_holds_the_map_back_for_its_lag(bus, world):
    shift = np.eye(4)
    shift[:3, 3] = (0.5, 0.0, 0.0)
    world.update = lambda keyframe, sequence: update_of(
        keyframe, sequence, (shift @ keyframe.world_from_camera)[None] if keyframe.id == 0 else None
    )
    run(bus, [frame(i) for i in range(10)], LOCKSTEP)
    off = {i: np.linalg.norm(p - true_position(i)) for i, p in positions(bus).items()}
    lag = LOCKSTEP.lockstep.map_lag
    assert all(off[i] < 0.05 for i in range(3, lag))
    assert all(off[i] == pytest.approx(0.5, abs=0.05) for i in range(lag, 10))


def test_lockstep_twice_is_the_same_to_the_last_bit():
    runs = []
    for _ in range(2):
        bus = ListBus("frame")
        World(bus)
        run(bus, [frame(i) for i in range(25)], LOCKSTEP)
        runs.append(positions(bus))
    assert runs[0].keys() == runs[1].keys()
    for i, position in runs[0].items():
        assert position.tolist() == runs[1][i].tolist()


def test_lockstep_goes_on_without_an_answer_that_never_comes(bus, world, monkeypatch, caplog):
    monkeypatch.setattr(answers_due, "PATIENCE_S", 0.02)
    world.update = world.scale = None
    run(bus, [frame(i) for i in range(12)], LOCKSTEP)
    assert [a.index for a in bus.of("acknowledged")] == list(range(12))
    assert len(bus.of("pose")) == 9
    assert "no map_update of keyframe 0" in caplog.text
    waiting = bus.budgets_s["waiting for map_update of keyframe 0"]
    assert waiting > answers_due.PATIENCE_S, "the others' time, not ours"
    assert bus.budgets_s["frame 11"] == 5.0


def test_answers_that_come_in_another_order_are_each_found(bus, world):
    """Scale and update of a keyframe may be there before its depth, or a later keyframe's before them."""
    held = []
    world.depth = None

    def heard(topic, message):
        World.heard(world, topic, message)
        if topic == "keyframe_image":
            held.append(message)
        if topic == "tracked" and held and message.index >= held[0].index + 2:
            bus.give("depth", depth_of(held.pop(0)))

    bus.hear = heard
    run(bus, [frame(i) for i in range(20)], LOCKSTEP)
    assert [t.index for t in bus.of("tracked") if t.published] == list(range(3, 20))


def test_a_process_that_was_started_anew_numbers_its_keyframes_anew(bus, world):
    bus.life, bus.first_id = 1, IDS_A_LIFE
    run(bus, [frame(i) for i in range(50, 53)])
    assert bus.of("keyframe")[0].id == IDS_A_LIFE
    assert bus.of("tracked")[-1].dropped == 0, "what came while it was down was not dropped by it"


def test_a_map_that_was_given_up_is_owed_no_answers(bus, world, monkeypatch, caplog):
    """What the others dropped with it never comes: each would be waited for half a minute."""
    monkeypatch.setattr(answers_due, "PATIENCE_S", 0.02)

    def heard(topic, message):
        world.update = update_of if topic == "keyframe" and message.epoch else None
        World.heard(world, topic, message)

    bus.hear = heard
    when_frames_left(bus, 10, "reset")
    run(bus, [frame(i) for i in range(12)], LOCKSTEP)
    assert [reply.ok for reply in bus.desk.replies] == [True]
    assert {k.epoch for k in bus.of("keyframe")} == {0, 1}
    assert "going on without" not in caplog.text
