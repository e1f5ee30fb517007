"""A process on another host, as health shows it."""

from __future__ import annotations

import logging
from dataclasses import replace

import pytest

from prism_edge.bus.session import Bus
from prism_edge.bus.vacancy import free_endpoint
from prism_edge.config import Config, DepthConfig, NetworkConfig
from prism_edge.supervisor.health import ERROR, OK, WARN
from prism_edge.supervisor.remote import FIRST_S, REFUSED_S, UNHEARD_S, RemoteWatch
from prism_edge.supervisor.supervisor import Supervisor
from tests.supervisor.fake_daemon import cast
from tests.supervisor.test_liveness import beat
from tests.supervisor.whole_runs import in_time


def test_what_is_said_of_it() -> None:
    watch = RemoteWatch("depth", 5.0)
    assert (watch.row(0.0).level, watch.row(0.0).message) == (ERROR, "not heard from its host")
    watch.heard(beat("idle"), 10.0)
    assert (watch.row(10.5).level, watch.row(10.5).message) == (OK, "idle")
    watch.heard(replace(beat("idle"), values={"warning": "all NaN"}), 11.0)
    assert (watch.row(11.0).level, watch.row(11.0).message) == (WARN, "all NaN")
    cut = watch.row(11.1 + UNHEARD_S)
    assert cut.level == ERROR
    assert "silent" in cut.message
    watch.heard(beat("idle"), 60.0)  # the link has healed, or it was started again
    assert watch.row(60.0).level == OK


def test_a_link_that_is_cut_while_it_works_is_no_work_that_takes_long() -> None:
    watch = RemoteWatch("depth", 0.0)
    watch.heard(beat("working", activity="keyframe 6", budget_s=120.0), 10.0)
    assert watch.row(9.0 + UNHEARD_S).level == OK, "native code may keep it from beating"
    cut = watch.row(10.1 + UNHEARD_S)
    assert (cut.level, cut.message) == (ERROR, f"silent for {UNHEARD_S + 0.1:.1f} s")


def test_the_log_says_when_it_comes_and_goes_once_each(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    watch = RemoteWatch("depth", 5.0)

    def lines(*moments: float) -> list[str]:
        caplog.clear()
        for moment in moments:
            watch.tell(moment)
        return caplog.messages

    assert lines(5.0, 5.0 + 0.9 * FIRST_S) == []
    assert lines(5.0 + FIRST_S, 6.0 + FIRST_S) == ["depth, on another host: not heard from its host"]
    watch.heard(beat("idle"), 20.0)
    assert lines(20.1, 20.2) == ["depth is heard from its host"]
    (gone,) = lines(20.1 + UNHEARD_S, 30.0 + UNHEARD_S)
    assert gone.startswith("depth, on another host: silent")
    watch.heard(beat("idle"), 60.0)
    assert lines(60.1, 60.2) == ["depth is heard from its host"]


def test_one_that_is_there_at_once_is_told_of_too(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    watch = RemoteWatch("depth", 5.0)
    watch.heard(beat("idle"), 1.0)
    watch.tell(1.1)
    assert caplog.messages == ["depth is heard from its host"]


def test_it_is_not_started_here() -> None:
    network = NetworkConfig(endpoint="tcp/0.0.0.0:7448", remote=("depth",))
    supervisor = Supervisor(Config(depth=DepthConfig(model="net.onnx"), network=network))
    assert {"source", "tracker", "scale", "backend"} == set(supervisor._watches)
    assert set(supervisor._remote) == {"depth"}


def test_a_running_daemon_says_so(
    config: Config, left_behind: None, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    away = replace(config, network=NetworkConfig(endpoint=free_endpoint(), remote=("depth",)))
    with Supervisor(away, *cast(["source:steady", "depth:steady"])) as run, Bus.open(config, "depth") as bus:
        bus.pulse.ready()
        run.run(in_time(lambda: "depth is heard from its host" in caplog.messages))


def test_one_that_refuses_what_it_hears_is_not_well() -> None:
    watch = RemoteWatch("depth", 0.0)
    for at_s in (1.0, 5.0):
        watch.heard(replace(beat("ready"), values={"malformed": "3"}), at_s)
    assert watch.row(5.5).level == WARN
    assert "refuses messages (3 so far)" in watch.row(5.5).message
    watch.heard(replace(beat("ready"), values={"malformed": "3"}), 2.0 + REFUSED_S)
    assert watch.row(2.0 + REFUSED_S).level == OK, "none since"


def test_a_slow_link_holds_up_heartbeats_and_is_no_end() -> None:
    watch = RemoteWatch("depth", 0.0)
    watch.heard(beat("idle"), 1.0)
    watch.tell(1.1)
    assert watch.row(0.9 + UNHEARD_S).level == OK
    assert watch.row(1.1 + UNHEARD_S).level == ERROR


def test_one_whose_configuration_is_another_is_told_of(caplog: pytest.LogCaptureFixture) -> None:
    watch = RemoteWatch("scale", 0.0, {"mode": "lockstep", "depth.model": "a network"})
    watch.heard(replace(beat("idle"), values={"mode": "lockstep", "depth.model": "a network"}), 1.0)
    assert watch.row(1.5).level == OK
    watch.heard(replace(beat("idle"), values={"mode": "realtime", "depth.model": "empty"}), 2.0)
    watch.tell(2.5)
    assert watch.row(2.5).level == ERROR
    assert caplog.messages == [
        "scale, on another host: in its configuration mode is realtime (here lockstep), depth.model is empty "
        "(here a network): set both alike"
    ]


def test_one_that_is_started_again_with_another_mode_is_told(caplog: pytest.LogCaptureFixture) -> None:
    watch = RemoteWatch("depth", 0.0, {"mode": "realtime"})
    for at_s, mode in ((1.0, "realtime"), (3.0, "lockstep"), (4.0, "lockstep")):
        watch.heard(replace(beat("idle"), values={"mode": mode}), at_s)
        watch.tell(at_s)
    assert caplog.text.count("in its configuration mode is lockstep") == 1
