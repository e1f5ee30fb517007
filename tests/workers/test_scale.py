"""The scale worker on a bus of lists: what comes in is queued, what goes out is kept."""

from __future__ import annotations

import threading
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from prism_edge.config import Config, DepthConfig, GateConfig, ScaleConfig, SupervisorConfig
from prism_edge.messages import IDS_A_LIFE, Acknowledged, EndOfStream, Gate, MapLoaded, Scale
from prism_edge.workers.cut_off import TOLD
from prism_edge.workers.scale import ScaleWorker, main
from tests.scale.scene import depth_of, keyframe_of_wall
from tests.synthetic.messages import tick
from tests.tracking.cloud import pose_at
from tests.waiting import until
from tests.workers.list_bus import DEADLINE_S, ListBus

SCALE = ScaleConfig(hold_sigmas=0.0)


@pytest.fixture
def bus():
    bus = ListBus()
    yield bus
    bus.stopped.set()


@pytest.fixture
def start(bus):
    """Runs a worker in a thread that ends with the test."""
    threads = []

    def start(mode="realtime", patience_s=DEADLINE_S, model="wall", scale=SCALE, **changes):
        config = Config(mode=mode, scale=scale, depth=DepthConfig(model=model), **changes)
        thread = threading.Thread(target=ScaleWorker(config, bus, patience_s).run, daemon=True)
        threads.append(thread)
        thread.start()

    yield start
    bus.stopped.set()
    for thread in threads:
        thread.join(DEADLINE_S)
        assert not thread.is_alive()


def test_a_scale_that_was_started_again_goes_on_from_what_the_backend_has_heard(bus, start):
    """Metres don't jump to those of a map whose unit nobody knows."""
    asked = []
    bus.ask = lambda topic, timeout_s: asked.append(topic) or MapLoaded(3, np.log(1.5), 0.03, 0.1, "wall")
    bus.life, bus.first_id = 1, IDS_A_LIFE
    keyframes = [keyframe_of_wall(k, 0.4 * k, 1.55, epoch=3) for k in range(50, 53)]
    bus.give("depth", *(depth_of(k) for k in keyframes))
    bus.give("keyframe", *keyframes)
    start()
    bus.wait_for("log_scale", 3)
    assert asked == ["map_loaded"]
    assert bus.of("scale")[0].scale == pytest.approx(1.5), "said at once"
    for said in bus.of("log_scale"):
        assert abs(said.log_scale - np.log(1.5)) < 0.03
        assert said.filter_sigma < 0.05


@pytest.mark.parametrize("told", [True, False])
def test_the_first_of_a_run_that_goes_on_asks_for_what_the_last_run_knew(bus, start, tmp_path, told):
    """The backend's first life tells of it, but may have died before it had."""
    asked = []
    bus.ask = lambda topic, timeout_s: asked.append(topic) or MapLoaded(0, np.log(1.5), 0.03, 0.1, "wall")
    bus.run_directory = tmp_path
    if told:
        (tmp_path / TOLD).touch()
    keyframe = keyframe_of_wall(50, 20.0, 1.55)
    bus.give("depth", depth_of(keyframe))
    bus.give("keyframe", keyframe)
    start()
    bus.wait_for("log_scale", 1)
    assert asked == ["map_loaded"] * told
    assert (abs(bus.of("log_scale")[0].log_scale - np.log(1.5)) < 0.03) == told


def test_it_waits_for_a_backend_that_starts_beside_it_and_reads_a_long_journal(bus, start):
    """Nobody would answer before that, and what begins at 1 would take the place of what was known."""
    asks = "asking for the map's unit"
    waits_s, ready = [], []

    def await_ready(processes, timeout_s):
        waits_s.append(timeout_s)
        if timeout_s >= 15.0:
            ready.extend(processes)
        return set(processes) - set(ready)

    def ask(topic, timeout_s):
        waits_s.append(timeout_s)
        return MapLoaded(3, np.log(1.5), 0.03, 0.1, "wall") if "backend" in ready else None

    bus.await_ready, bus.ask = await_ready, ask
    bus.life, bus.first_id = 1, IDS_A_LIFE
    start()
    bus.wait_for("scale", 1)
    assert bus.of("scale")[0].scale == pytest.approx(1.5)
    assert sum(waits_s) < bus.budgets_s[asks] < SupervisorConfig().start_s, "it is not killed for it"


def test_a_network_out_of_its_depth_shows_on_health_until_a_map_begins_that_it_agrees_on(bus, start, caplog):
    keyframes = [keyframe_of_wall(k, 0.4 * k, parallax_deg=3.0 if k else 0.0) for k in range(60)]
    wavers = [np.exp(0.8 * np.sin(0.3 * k.id)) for k in keyframes]
    bus.give("depth", *(depth_of(k, factor) for k, factor in zip(keyframes, wavers, strict=True)))
    bus.give("keyframe", *keyframes)
    start()
    bus.wait_for("log_scale", 60)
    until(lambda: "differ in size" in bus.pulse.values.get("warning", ""))
    assert caplog.text.count("differ in size") == 1
    again = keyframe_of_wall(60, 24.0, parallax_deg=0.0, epoch=1)
    bus.give("depth", depth_of(again))
    bus.give("keyframe", again)
    until(lambda: "warning" not in bus.pulse.values)


@pytest.mark.parametrize("life", [0, 1])
def test_where_nothing_is_known_it_begins_afresh(bus, start, life):
    asked = []
    bus.ask = lambda topic, timeout_s: asked.append(topic)
    bus.life, bus.first_id = life, life * IDS_A_LIFE
    keyframe = keyframe_of_wall(0, 0.0, 1.5, parallax_deg=0.0)
    bus.give("depth", depth_of(keyframe))
    bus.give("keyframe", keyframe)
    start()
    bus.wait_for("log_scale", 1)
    assert len(asked) == life, "the first of a run has nobody to ask"
    assert bus.of("log_scale")[0].log_scale == 0.0


def test_each_pair_gives_scale_gate_and_the_public_scale(bus, start):
    keyframes = [keyframe_of_wall(k, 0.4 * k, 1.1, parallax_deg=3.0 if k else 0.0) for k in range(12)]
    bus.give("depth", *(depth_of(k) for k in keyframes))
    bus.give("keyframe", *keyframes)
    start()
    bus.wait_for("scale", 12)
    scales = bus.of("log_scale")
    assert [s.keyframe for s in scales] == list(range(12))
    assert all(s.metric for s in scales)
    assert all(isinstance(s, Scale) for s in scales)
    assert scales[0].log_scale == 0.0
    assert 0.02 < scales[-1].log_scale < np.log(1.1)
    assert all(isinstance(g, Gate) and (g.weights == 1).all() for g in bus.of("gate"))
    public = bus.of("scale")[-1]
    assert public.scale == pytest.approx(np.exp(scales[-1].log_scale))
    assert (public.sigma_log, public.filter_sigma_log) == (scales[-1].sigma, scales[-1].filter_sigma)
    assert (public.keyframe, public.points, public.accepted, public.metric) == (11, 200, True, True)
    assert public.header.frame_id == "map"
    assert public.header.stamp.sec * 10**9 + public.header.stamp.nanosec == keyframes[-1].stamp_ns
    assert bus.pulse.values["observations"] == "11"
    assert bus.pulse.values["rejected"] == "0"
    assert float(bus.pulse.values["log_scale"]) == pytest.approx(scales[-1].log_scale, abs=1e-4)
    assert float(bus.pulse.values["sigma"]) == pytest.approx(scales[-1].sigma, abs=1e-4)
    assert bus.states[0] == "ready"


@pytest.mark.parametrize("images", [False, True])
def test_u_and_w_are_shown_where_that_is_asked_for(bus, start, images):
    keyframes = [keyframe_of_wall(k, 0.4 * k) for k in range(2)]
    bus.give("depth", *(depth_of(k, dsug_tau=0.2, dsug_temperature=0.05) for k in keyframes))
    bus.give("keyframe", *keyframes)
    start(gate=GateConfig(images=images))
    bus.wait_for("scale", 2)
    if not images:
        assert not bus.of("uncertainty")
        return
    bus.wait_for("weight", 2)
    u, w = bus.of("uncertainty")[-1], bus.of("weight")[-1]
    assert (u.encoding, u.height, u.width, u.step) == ("32FC1", 120, 160, 640)
    assert u.header.frame_id == "camera_optical"
    assert np.nanmax(u.data.view("<f4")) < 0.01
    assert np.isnan(bus.of("uncertainty")[0].data.view("<f4")).all(), "a first keyframe has nothing before it"
    assert np.all(w.data.view("<f4") > 0.9)


def test_a_keyframe_that_comes_after_its_depth_is_served_too(bus, start):
    keyframe = keyframe_of_wall(3, 1.0)
    bus.give("depth", depth_of(keyframe))
    start()
    bus.give("keyframe", keyframe)
    bus.wait_for("scale", 1)
    assert bus.of("log_scale")[0].keyframe == 3


def test_depth_that_is_told_again_waits_for_nobody(bus, start):
    """It would push out those that wait for their keyframe."""
    old, new = keyframe_of_wall(3, 1.0), keyframe_of_wall(4, 1.0)
    bus.give("depth", depth_of(old))
    bus.give("keyframe", old)
    start()
    bus.wait_for("scale", 1)
    waiting = [replace(depth_of(new), keyframe=i) for i in range(9, 72)]
    bus.give("depth", depth_of(new), depth_of(old), *waiting)
    bus.give("keyframe", new)
    bus.wait_for("scale", 2)
    assert bus.pulse.values["unpaired"] == "0"


def test_what_a_lost_camera_shows_takes_no_keyframe_s_place(bus, start):
    keyframe = keyframe_of_wall(3, 1.0)
    depth = depth_of(keyframe)
    bus.give("depth", depth, *(replace(depth, keyframe=-2 - i) for i in range(100)))
    start()
    bus.give("keyframe", keyframe)
    bus.wait_for("scale", 1)
    assert bus.of("log_scale")[0].keyframe == 3
    assert bus.pulse.values["unpaired"] == "0"


def test_the_gate_hears_of_keyframes_whose_depth_never_comes(bus, start):
    moved = pose_at(40.0, 1.0, -2.0, 0.3, 0.5)
    first, blind, last = (keyframe_of_wall(k, 0.4 * k) for k in range(3))
    last = replace(last, world_from_camera=moved, anchor=1, world_from_anchor=moved)
    fitted = {"dsug_tau": 0.2, "dsug_temperature": 0.05}
    start()
    for count, (keyframe, depth) in enumerate(((first, first), (blind, None), (last, last)), 1):
        bus.give("keyframe", keyframe)
        if depth is not None:
            bus.give("depth", depth_of(depth, **fitted))
            bus.wait_for("gate", (count + 1) // 2)
    assert np.nanmax(bus.of("gate")[-1].uncertainty) < 0.02


def test_an_unusable_depth_is_answered_without_an_observation(bus, start):
    keyframe = keyframe_of_wall(0, 0.0)
    bus.give("keyframe", keyframe)
    bus.give("depth", replace(depth_of(keyframe), valid=False, reason="constant"))
    start()
    bus.wait_for("scale", 1)
    scale = bus.of("log_scale")[0]
    assert np.isnan(scale.observation)
    assert not scale.accepted
    assert scale.log_scale == 0.0
    assert not scale.metric
    assert not bus.of("scale")[0].metric


def test_the_uncertainty_grows_while_no_depth_comes_and_late_depth_still_counts(bus, start, monkeypatch):
    keyframes = [keyframe_of_wall(k, 20.0 * k) for k in range(4)]
    bus.give("depth", depth_of(keyframes[0]))
    bus.give("keyframe", keyframes[0])
    monkeypatch.setattr("prism_edge.workers.scale._SILENT_S", -1.0)
    start()
    bus.wait_for("scale", 1)
    for count, keyframe in enumerate(keyframes[1:], 2):
        bus.give("keyframe", keyframe)
        bus.wait_for("scale", count)
    public = bus.of("scale")[-3:]
    sigmas = [message.filter_sigma_log for message in public]
    assert sigmas == sorted(sigmas)
    assert sigmas[0] < sigmas[-1]
    assert all(message.metric and not message.accepted and message.points == 0 for message in public)
    assert len(bus.of("gate")) == 1, "nothing is known of these keyframes' pixels"
    bus.give("depth", depth_of(keyframes[3]))
    bus.wait_for("scale", 5)
    assert bus.of("scale")[-1].points > 0


def test_a_keyframe_after_a_long_time_is_not_answered_before_its_depth(bus, start, monkeypatch):
    """In a known place there is one every ten seconds, and none of them was too late."""
    clock = SimpleNamespace(monotonic=lambda: clock.now_s, now_s=100.0)
    monkeypatch.setattr("prism_edge.workers.scale.time", clock)
    keyframes = [keyframe_of_wall(k, 10.0 * k) for k in range(3)]
    start()
    for count, keyframe in enumerate(keyframes, 1):
        clock.now_s += 10.0
        bus.give("keyframe", keyframe)
        until(lambda: not bus.inboxes["keyframe"].waiting, "the keyframe is taken")
        bus.give("depth", depth_of(keyframe))
        bus.wait_for("scale", count)
    assert [(message.keyframe, message.points > 0) for message in bus.of("scale")] == [
        (keyframe.id, True) for keyframe in keyframes
    ]


@pytest.mark.parametrize(
    ("mode", "begun", "said"),
    [("realtime", True, [0, 5, 6, 7]), ("lockstep", True, [0]), ("realtime", False, [])],
)
def test_keyframes_that_come_often_hide_no_silence_of_the_network(bus, monkeypatch, mode, begun, said):
    """One a second, none of which ever gets its depth: after three the metres are said to be less sure.

    Not in lockstep, which waits for each; nor where nothing has said a metre yet.
    """
    clock = SimpleNamespace(monotonic=lambda: clock.now_s, now_s=100.0)
    monkeypatch.setattr("prism_edge.workers.scale.time", clock)
    worker = ScaleWorker(Config(mode=mode, scale=SCALE, depth=DepthConfig(model="wall")), bus)
    keyframes = [keyframe_of_wall(k, 20.0 * k) for k in range(8)]
    if begun:
        bus.give("depth", depth_of(keyframes[0]))
    for keyframe in keyframes[0 if begun else 1 :]:
        bus.give("keyframe", keyframe)
        worker._take_depth(0.0)
        clock.now_s += 1.0
    assert [message.keyframe for message in bus.of("scale")] == said
    sigmas = [message.filter_sigma_log for message in bus.of("scale")]
    assert sigmas == sorted(set(sigmas))


def test_without_any_depth_there_is_no_scale_to_speak_of(bus, start, monkeypatch):
    monkeypatch.setattr("prism_edge.workers.scale._SILENT_S", -1.0)
    bus.give("keyframe", *[keyframe_of_wall(k, 0.4 * k) for k in range(2)])
    last = keyframe_of_wall(5, 2.0)
    bus.give("keyframe", last)
    bus.give("depth", depth_of(last))
    start()
    bus.wait_for("scale", 1)
    assert [message.keyframe for message in bus.of("scale")] == [5]


def test_an_outlier_is_counted_and_said(bus, start, caplog):
    caplog.set_level("INFO", "prism_edge.scale")
    keyframes = [keyframe_of_wall(k, 0.4 * k) for k in range(8)]
    bus.give("keyframe", *keyframes)
    bus.give("depth", *(depth_of(k, 10.0 if k.id == 7 else 1.0) for k in keyframes))
    start()
    bus.wait_for("scale", 8)
    assert not bus.of("log_scale")[-1].accepted
    assert bus.pulse.values["rejected"] == "1"
    assert "keyframe 7: log scale 2.30" in caplog.text


def test_ablations_reach_the_estimator(bus, start):
    keyframes = [keyframe_of_wall(k, 0.4 * k) for k in range(3)]
    bus.give("keyframe", *keyframes)
    bus.give("depth", *(depth_of(k, 1.0 + 0.1 * k.id) for k in keyframes))
    start(ablate=("kalman",))
    bus.wait_for("scale", 3)
    observed = [(s.log_scale, s.observation) for s in bus.of("log_scale")]
    assert all(estimate == observation for estimate, observation in observed)


def test_lockstep_acknowledges_a_frame_once_its_scale_is_out(bus, start):
    keyframe = keyframe_of_wall(5, 0.1)
    bus.give("tracked", tick(0), tick(1), tick(2, keyframe=5), tick(3))
    start("lockstep")
    bus.wait_for("acknowledged", 2)
    bus.give("keyframe", keyframe)
    assert [a.index for a in bus.of("acknowledged")] == [0, 1]  # depth is still to come
    bus.give("depth", depth_of(keyframe))
    bus.wait_for("acknowledged", 4)
    assert bus.of("acknowledged") == [Acknowledged("scale", i) for i in range(4)]
    order = [topic for topic, _ in bus.sent]
    assert order.index("log_scale") < order.index("gate") < order.index("acknowledged", 2)


def test_lockstep_goes_on_without_a_depth_that_never_comes(bus, start, caplog):
    bus.give("keyframe", keyframe_of_wall(5, 0.1))
    bus.give("tracked", tick(0, keyframe=5), tick(1))
    start("lockstep", patience_s=0.05)
    bus.wait_for("acknowledged", 2)
    assert np.isnan(bus.of("log_scale")[0].observation)
    assert "keyframe 5 has no depth" in caplog.text


def test_lockstep_does_not_wait_for_what_has_been_served(bus, start):
    """Depth and keyframe of a later frame may be in before an earlier frame's tick is handled."""
    keyframes = [keyframe_of_wall(k, 0.4 * k) for k in range(2)]
    bus.give("keyframe", *keyframes)
    bus.give("depth", *(depth_of(k) for k in keyframes))
    bus.give("tracked", tick(0, keyframe=0), tick(1), tick(2, keyframe=1))
    start("lockstep")
    bus.wait_for("acknowledged", 3)
    assert len(bus.of("log_scale")) == 2


def test_it_stays_after_the_end_and_leaves_when_stopped(bus):
    thread = threading.Thread(target=main, args=(Config(depth=DepthConfig(model="wall")), bus), daemon=True)
    bus.give("end", EndOfStream(1, 1, 0, 0, 0))
    thread.start()
    keyframe = keyframe_of_wall(0, 0.0)
    bus.give("keyframe", keyframe)
    bus.give("depth", depth_of(keyframe))
    bus.wait_for("scale", 1)
    assert thread.is_alive()
    bus.stopped.set()
    thread.join(DEADLINE_S)
    assert not thread.is_alive()
    assert "ended" in bus.states
