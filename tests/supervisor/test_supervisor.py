"""Whole runs of fake workers: death, restart, giving up, hangs, and nothing left behind."""

from __future__ import annotations

import os
import signal
import socket
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from prism_edge.bus.commands import Reply, send
from prism_edge.bus.links import open_session
from prism_edge.bus.session import Bus
from prism_edge.config import (
    Config,
    DepthConfig,
    MetricsConfig,
    SourceConfig,
    StateConfig,
)
from prism_edge.errors import BusError, ConfigError, SupervisionError
from prism_edge.processes import Process
from prism_edge.supervisor import supervisor as module
from prism_edge.supervisor.child import Child
from prism_edge.supervisor.health import ERROR, OK, WARN
from prism_edge.supervisor.kept_journal import LOCK
from prism_edge.supervisor.reload import put
from prism_edge.supervisor.run_directory import PREFIX
from prism_edge.supervisor.supervisor import Supervisor
from prism_edge.supervisor.watch import StartRefusedError
from prism_edge.topics import COMMANDS
from prism_edge.workers.cut_off import MARK
from tests.supervisor.fake_daemon import cast
from tests.supervisor.whole_runs import DEADLINE_S, in_time, running
from tests.waiting import until


def supervisor(config: Config, *behaviours: str) -> Supervisor:
    return Supervisor(config, *cast(behaviours))


def levels(health: Any) -> dict[str, int]:
    return {status.name: int(status.level) for status in health.status}


def values(health: Any, name: str) -> dict[str, str]:
    status = next(status for status in health.status if status.name == name)
    return {pair.key: pair.value for pair in status.values}


class Health:
    """What `health` has said so far; linked, so that nothing that comes is missed."""

    def __init__(self, run: Supervisor, bus: Bus) -> None:
        self._inbox = bus.queue("health")
        self._heard: list[Any] = []
        run.run(in_time(self.heard))

    def heard(self) -> list[Any]:
        self._heard += self._inbox.drain()
        return self._heard


@pytest.mark.usefixtures("left_behind", "slow_is_not_silent")
class TestSupervisor:
    def test_ready_when_all_are_and_health_says_so(self, config: Config) -> None:
        with supervisor(config, "source:steady", "tracker:steady") as run, Bus.open(config, "test") as bus:
            Health(run, bus)
            run.run(in_time(lambda: run.ready_s is not None))
            pids = run.processes
            assert pids.keys() == {"source", "tracker"}
            health = bus.ask("health", DEADLINE_S)
            assert levels(health) == {"supervisor": OK, "source": OK, "tracker": OK}
            assert values(health, "supervisor")["state"] == "ready"
            assert values(health, "supervisor")["pid"] == str(os.getpid())
            assert float(values(health, "supervisor")["ready_s"]) > 0
            assert all(values(health, name)["pid"] == str(pid) for name, pid in pids.items())
        assert not any(running(pid) for pid in pids.values())

    def test_death_is_reported_and_mended(self, config: Config) -> None:
        with supervisor(config, "source:steady", "tracker:steady") as run, Bus.open(config, "test") as bus:
            health = Health(run, bus)
            run.run(in_time(lambda: run.ready))
            before = run.processes
            os.kill(before["tracker"], signal.SIGKILL)
            run.run(in_time(lambda: run.processes.get("tracker", 0) not in (0, before["tracker"])))
            run.run(in_time(lambda: run.ready))
            assert run.processes["source"] == before["source"]
            until(lambda: any(mended(h) for h in health.heard()))
            down = [h for h in health.heard() if levels(h)["tracker"] == ERROR]
            assert down
            assert values(down[0], "tracker")["last_exit"] == "killed by SIGKILL"
            assert levels(down[0])["supervisor"] == ERROR
            assert levels(down[0])["source"] == OK

    def test_what_it_says_of_itself_holds_no_password(self, config: Config) -> None:
        camera = SourceConfig(uri="rtsp://me:secret@cam/live?key=secret#timeout=3")
        config = replace(config, source=camera)
        with supervisor(config, "source:steady", "tracker:steady") as run, Bus.open(config, "test") as bus:
            Health(run, bus)
            run.run(in_time(lambda: run.ready_s is not None))
            reply, health = told(run, config), bus.ask("health", DEADLINE_S)
        assert reply.ok
        assert reply.values["input"] == "rtsp://cam/live?..."
        assert "secret" not in f"{reply} {health}"

    @pytest.mark.parametrize("model", ["", "none"])
    def test_without_a_depth_network_it_says_that_no_pose_comes(
        self, config: Config, model: str, caplog: pytest.LogCaptureFixture
    ) -> None:
        config = replace(config, depth=DepthConfig(model))
        workers = ("source:steady", "tracker:tracks=initialising")
        with supervisor(config, *workers) as run, Bus.open(config, "test") as bus:
            assert "no pose comes" in caplog.text
            Health(run, bus)
            run.run(in_time(lambda: run.ready_s is not None))
            reply, health = told(run, config), bus.ask("health", DEADLINE_S)
            assert run.healthy  # no reason for a watchdog to bite
        assert not reply.ok
        assert "no pose comes" in reply.said
        assert (reply.values["model"], "no network" in reply.values["depth"]) == ("none", True)
        assert levels(health) == {"supervisor": WARN, "source": OK, "tracker": OK, "depth": WARN}

    def test_a_loaded_map_needs_no_depth_network(self, config: Config) -> None:
        with supervisor(replace(config, depth=DepthConfig()), "source:steady", "tracker:tracks=ok") as run:
            run.run(in_time(lambda: run.ready_s is not None))
            assert told(run, config).ok

    def test_info_tells_the_provider_and_a_camera_that_is_away_which_is_no_failure(
        self, config: Config
    ) -> None:
        away, provider = "camera: reconnecting (no such device)", "CPUExecutionProvider"
        workers = (f"source:shows=warning:{away}", "tracker:steady", f"depth:shows=provider:{provider}")
        with supervisor(config, *workers) as run:
            run.run(in_time(lambda: run.ready_s is not None))
            reply = told(run, config)
        assert reply.ok
        assert away in reply.said
        assert (reply.values["source"], reply.values["provider"]) == (away, provider)

    def test_gives_up_on_what_keeps_dying(self, config: Config) -> None:
        run = supervisor(config, "source:steady", "tracker:dies")
        with pytest.raises(SupervisionError, match="tracker died more than 2 times"), run:
            run.run(in_time(lambda: False))
        assert run.processes == {}

    def test_hang_is_told_from_work_and_ended(self, config: Config, tmp_path: Path) -> None:
        note = tmp_path / "note"
        note.touch()  # it begins once somebody hears of it
        with supervisor(config, f"depth:waits={note}+hangs") as run, Bus.open(config, "test") as bus:
            health = Health(run, bus)
            first = run.processes["depth"]
            note.unlink()
            run.run(in_time(lambda: run.processes.get("depth", first) != first))
            assert not running(first)
            # A supervisor that was held up itself tells a hang at once, and how it ended two seconds later.
            until(lambda: any(values(h, "depth")["last_exit"] for h in health.heard()))
            assert any(levels(h)["depth"] == ERROR for h in health.heard())
            assert "inference has taken" in values(health.heard()[-1], "depth")["last_exit"]

    def test_a_source_that_starts_again_and_waits_for_its_camera_is_no_reason_to_restart_all(
        self, config: Config, tmp_path: Path
    ) -> None:
        away = tmp_path / "away"
        with supervisor(config, f"source:waits={away}", "tracker:tracks=ok") as run:
            run.run(in_time(lambda: run.ready_s is not None))
            os.kill(run.processes["source"], signal.SIGKILL)
            run.run(in_time(lambda: run.alive and not run.healthy))
            assert told(run, config).ok

    def test_an_end_that_was_asked_for_is_none_that_was_cut_off_though_it_takes_too_long(
        self, config: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """A service manager has less patience than `stop_s`, and kills the supervisor too."""
        live = SourceConfig(uri="http://127.0.0.1:9/video")
        config = replace(config, source=live, state=StateConfig(directory=str(tmp_path / "state")))
        mark, seen = tmp_path / "state" / "journal" / MARK, []
        with supervisor(config, "source:steady", "tracker:steady") as run:
            run.run(in_time(lambda: run.ready))
            assert mark.exists()
            terminate = Child.terminate
            monkeypatch.setattr(
                Child, "terminate", lambda child: (seen.append(mark.exists()), terminate(child))[1]
            )
            run.ended_well()
        assert seen == [False, False]

    def test_stubborn_worker_is_killed(self, config: Config) -> None:
        with supervisor(config, "source:stubborn", "tracker:steady") as run:
            run.run(in_time(lambda: run.ready))
            pids = run.processes
        assert not any(running(pid) for pid in pids.values())

    def test_what_a_worker_started_dies_with_it(self, config: Config, tmp_path: Path) -> None:
        note = tmp_path / "pid"
        with supervisor(config, f"backend:breeds={note}") as run:
            run.run(in_time(lambda: note.exists() and note.read_text().endswith("\n")))
            bred = int(note.read_text())
            assert running(bred)
        until(lambda: not running(bred))

    def test_users_error_ends_the_run_with_its_code_and_one_line(
        self, config: Config, capfd: pytest.CaptureFixture[str]
    ) -> None:
        run = supervisor(config, "source:steady", "depth:refuses")
        with pytest.raises(StartRefusedError) as caught, run:
            run.run(in_time(lambda: False))
        assert caught.value.exit_code == 5
        assert run.processes == {}
        said = capfd.readouterr().err
        assert "prism-edge depth: error: net.onnx is no ONNX model; give another\n" in said
        assert "Traceback" not in said

    def test_all_start_where_it_can_not_be_told_beforehand_whether_the_endpoint_is_free(
        self, config: Config, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(module, "can_listen", lambda endpoint: False)
        with supervisor(config, "tracker:steady", "depth:steady") as run:
            run.run(in_time(lambda: run.ready))

    def test_endpoint_in_use_is_the_users_error(self, config: Config) -> None:
        with socket.socket() as other:
            host, port = config.bus.endpoint.removeprefix("tcp/").split(":")
            other.bind((host, int(port)))
            other.listen()
            run = supervisor(config, "source:steady")
            with pytest.raises(BusError):
                run.start()
            assert run.processes == {}

    @pytest.mark.parametrize("why", ["its camera", "its endpoint"])
    def test_a_start_that_was_refused_is_no_run_that_was_cut_off(
        self, config: Config, tmp_path: Path, why: str
    ) -> None:
        live = SourceConfig(uri="http://127.0.0.1:9/video")
        config = replace(config, source=live, state=StateConfig(directory=str(tmp_path / "state")))
        with socket.socket() as other:
            if why == "its endpoint":
                host, port = config.bus.endpoint.removeprefix("tcp/").split(":")
                other.bind((host, int(port)))
                other.listen()
            run = supervisor(config, "source:refuses")
            with pytest.raises((BusError, StartRefusedError)), run:
                run.run(in_time(lambda: False))
        assert {path.name for path in (tmp_path / "state" / "journal").iterdir()} == {LOCK}

    def test_a_port_of_metrics_in_use_is_said_before_any_process_is_started(self, config: Config) -> None:
        launched: list[str] = []

        def start(process: Process, config_file: Path, life: int) -> Child:
            launched.append(process.name)
            return Child.spawn([sys.executable, "-c", ""])

        with socket.socket() as other:
            other.bind(("127.0.0.1", 0))
            other.listen()
            taken = replace(config, metrics=MetricsConfig(other.getsockname()[1]))
            run = Supervisor(taken, cast(["source:steady"])[0], start)
            with pytest.raises(ConfigError, match=r"metrics\.port: can't listen"):
                run.start()
        assert launched == []

    def test_a_bad_setting_that_is_reloaded_again_and_again_is_taken_back(
        self, config: Config, caplog: pytest.LogCaptureFixture
    ) -> None:
        bad = put(config, "depth.threads", 13)
        with supervisor(config, "tracker:steady", "depth:picky") as run:
            run.run(in_time(lambda: run.ready))
            first = run.processes["depth"]
            run.reload(bad)
            run.reload(bad)  # it has been asked to end
            run.run(in_time(lambda: run.processes.get("depth", first) != first))
            run.reload(bad)  # it is on trial
            run.run(in_time(lambda: run.ready))
        assert caplog.text.count("depth refuses what was reloaded") == 1

    def test_what_takes_up_a_setting_is_asked_to_end_and_not_killed(self, config: Config) -> None:
        with supervisor(config, "tracker:steady", "depth:steady") as run:
            run.run(in_time(lambda: run.ready))
            first = run.processes["depth"]
            run.reload(put(config, "depth.threads", 13))
            run.run(in_time(lambda: run.processes.get("depth", first) != first))
            assert run._watches["depth"].row(time.monotonic()).values["last_exit"] == "exit code 0"

    def test_a_bad_setting_that_finds_its_process_down_is_taken_back(self, config: Config) -> None:
        with supervisor(config, "tracker:steady", "depth:picky") as run:
            run.run(in_time(lambda: run.ready))
            os.kill(run.processes["depth"], signal.SIGKILL)
            run.run(in_time(lambda: "depth" not in run.processes))
            run.reload(put(config, "depth.threads", 13))
            run.run(in_time(lambda: run.ready))

    def test_a_setting_with_which_a_process_keeps_dying_is_taken_back(
        self, config: Config, caplog: pytest.LogCaptureFixture
    ) -> None:
        with supervisor(config, "tracker:steady", "depth:fragile") as run:
            run.run(in_time(lambda: run.ready))
            run.reload(put(config, "depth.threads", 13))
            run.run(in_time(lambda: "going back" in caplog.text and run.ready))
        assert caplog.text.count("depth ended with exit code 9; starting it again") == 1

    @pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")
    def test_going_back_that_a_full_disk_forbids_ends_nothing(
        self, config: Config, tmp_path: Path, caplog: pytest.LogCaptureFixture
    ) -> None:
        with supervisor(config, "tracker:steady", "depth:picky") as run:
            run.run(in_time(lambda: run.ready))
            before = run.processes
            run.reload(put(config, "depth.threads", 13))
            [folder] = tmp_path.glob(PREFIX + "*")
            (folder / ".new-config.yaml").symlink_to("/dev/full")
            run.run(in_time(lambda: "can't go back: " in caplog.text))
            (folder / ".new-config.yaml").unlink()
            run.run(in_time(lambda: run.ready))  # it goes back at the next refusal
            assert run.processes["tracker"] == before["tracker"]
            assert "threads: 1\n" in (folder / "config.yaml").read_text()

    def test_one_that_can_not_be_started_again_is_tried_again(self, config: Config) -> None:
        processes, start = cast(["tracker:steady", "depth:steady"])
        fails: list[OSError] = []

        def now_and_then(process: Process, config_file: Path, life: int) -> Child:
            if fails:
                raise fails.pop()
            return start(process, config_file, life)

        with Supervisor(config, processes, now_and_then) as run:
            run.run(in_time(lambda: run.ready))
            before = run.processes["depth"]
            fails.append(OSError(11, "Resource temporarily unavailable"))
            os.kill(before, signal.SIGKILL)
            run.run(in_time(lambda: run.processes.get("depth", before) != before and run.ready))
            assert not fails

    def test_ended_when_every_process_has(self, config: Config) -> None:
        with supervisor(config, "source:ends", "tracker:ends") as run:
            run.run(in_time(lambda: run.ended))


    def test_only_the_source_that_was_started_says_that_the_recording_is_over(
        self, config: Config, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        with supervisor(config, "source:steady", "tracker:steady") as run:
            run.run(in_time(lambda: run.ready))
            watch, pids = run._watches["source"], []
            hear = watch.heard
            monkeypatch.setattr(watch, "heard", lambda beat, now: (pids.append(beat.pid), hear(beat, now)))
            with Bus.open(config, "source") as stranger:
                stranger.pulse.ended()
                run.run(in_time(lambda: pids.count(os.getpid()) > 3))
            assert run._source_ended_s is None
            assert watch.state != "ended"


def told(run: Supervisor, config: Config) -> Reply:
    """What `ctl info` gets."""
    heard: list[Reply] = []

    def ask() -> None:
        with open_session(config.bus, listen=False, client=True) as session:
            heard.append(send(session, config.robot, COMMANDS["info"], None, DEADLINE_S))

    asking = threading.Thread(target=ask)
    asking.start()
    run.run(in_time(lambda: not asking.is_alive()))
    return heard[0]


def mended(health: Any) -> bool:
    return values(health, "tracker")["restarts"] == "1" and levels(health)["tracker"] == OK


def test_defect_of_a_worker_is_logged_and_counts_as_a_death(
    config: Config, capfd: pytest.CaptureFixture[str]
) -> None:
    run = supervisor(config, "scale:raises")
    with pytest.raises(SupervisionError, match="exit code 70"), run:
        run.run(in_time(lambda: False))
    assert "RuntimeError: a defect" in capfd.readouterr().err
