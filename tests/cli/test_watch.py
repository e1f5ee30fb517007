"""`prism-edge watch` hears what is published, as any subscriber would."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from rich.table import Table as RichTable

from prism_edge.bus import ros
from prism_edge.bus.session import Bus
from prism_edge.bus.vacancy import free_endpoint
from prism_edge.cli import watch
from prism_edge.cli.live_view import LiveView
from prism_edge.cli.main import main
from prism_edge.cli.watch import Listener, Table, _is_stream
from prism_edge.config import BusConfig, Config, FramesConfig
from prism_edge.evaluation.trajectory import read_tum
from prism_edge.geometry.mount import base_from_camera, looking
from prism_edge.messages import Tracked
from tests.waiting import until

MS = 1_000_000
COVARIANCE = np.diag([0.01, 0.01, 0.02, 0, 0, 0])
SCALE = ros.scale(0, "map", np.log(1.5), 0.1, 0.02, metric=True)


def looking_left_from_the_mast() -> np.ndarray:
    frames = FramesConfig(base_from_camera_xyz=(0.5, -0.1, 1.2), base_from_camera_xyzw=tuple(looking(30, 10)))
    return base_from_camera(frames)


def pose_at(x: float) -> np.ndarray:
    pose = np.eye(4)
    pose[0, 3] = x
    return pose


@pytest.fixture
def mounted() -> np.ndarray | None:
    """Where the daemon's camera sits on its robot; None: it doesn't say."""
    return None


@pytest.fixture
def endpoint(mounted: np.ndarray | None) -> Iterator[str]:
    """Where a daemon publishes: one metre a second along x, 33 ms a frame, until the test is over."""
    endpoint = free_endpoint()
    over = threading.Event()

    def publish() -> None:
        with Bus.open(Config(robot="fake", bus=BusConfig(endpoint)), "tracker", listen=True) as bus:
            stamp = 0
            while not over.wait(0.005):
                stamp += 33 * MS
                pose, captured = pose_at(stamp * 1e-9), time.monotonic_ns() - 20 * MS
                twist, still = np.zeros(6), COVARIANCE
                bus.publish("odom", ros.odometry(stamp, "odom", "base_link", pose, COVARIANCE, twist, still))
                bus.publish("tracked", Tracked(0, stamp, captured, "ok", True, -1, 0, np.eye(4)))
                bus.publish("scale", SCALE)
                bus.publish("status", ros.diagnostics(stamp, [("tracking", 0, "ok building", {})]))
                bus.publish("pose", ros.pose_with_covariance(stamp, "map", pose, COVARIANCE))
                if mounted is not None:
                    links = [("odom", "body", pose), ("body", "eye", mounted)]
                    tree = ros.transforms((stamp, *link) for link in links)
                    bus.publish_if_heard("tf", lambda tree=tree: tree)

    thread = threading.Thread(target=publish)
    thread.start()
    yield endpoint
    over.set()
    thread.join()


def test_prints_one_line_a_pose(endpoint: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["watch", "--robot", "fake", "--endpoint", endpoint, "--plain", "--count", "60"]) == 0
    said = capsys.readouterr()
    lines = said.out.splitlines()
    assert len(lines) == 60
    assert "watching prism/fake" in said.err
    last = lines[-1]
    assert "sigma 0.200 m" in last
    assert "speed 1.00 m/s" in last
    assert "scale 1.500 ± 0.150" in last
    assert "state ok building" in last
    latency_ms = float(last.partition("latency ")[2].split()[0])
    assert 20.0 <= latency_ms < 5000.0


@pytest.mark.parametrize("address", ["127.0.0.1", "0.0.0.0"])
def test_a_daemon_that_stands_still_tells_what_it_said_last(address: str) -> None:
    """Paused, it publishes nothing: what it said before is asked for once it is linked.

    Whatever address of this host it is asked at: not loopback's alone.
    """
    config = Config(robot="fake", bus=BusConfig(free_endpoint(), retry_ms=50))
    asked = replace(config, bus=BusConfig(config.bus.endpoint.replace("127.0.0.1", address), retry_ms=50))
    with (
        Bus.open(config, "supervisor", listen=True) as supervisor,
        Bus.open(config, "tracker") as tracker,
        Bus.open(config, "scale") as scale,
    ):
        tracker.publish("status", ros.diagnostics(MS, [("tracking", 0, "ok building", {})]))
        scale.publish("scale", SCALE)
        for process in (tracker, scale):
            process.pulse.ready()
        assert supervisor.await_ready(["tracker", "scale"], 10.0) == set()
        with Bus.open(asked, "watch") as bus:
            view = Listener(bus, asked).view
    assert view.state == "ok building"
    assert view.scale == pytest.approx(1.5)


def test_what_waits_counts_from_when_it_came() -> None:
    """The first poses wait while state and scale are asked for."""
    config = Config(robot="fake", bus=BusConfig(free_endpoint(), retry_ms=50))
    with Bus.open(config, "tracker", listen=True) as tracker, Bus.open(config, "watch") as bus:
        listener = Listener(bus, config)

        def came() -> bool:
            tracker.publish("pose", ros.pose_with_covariance(MS, "map", np.eye(4), COVARIANCE))
            return bool(listener._poses._samples)

        until(came, "a pose")
        came_before_s = time.monotonic()
        assert next(listener.poses(1))
        assert listener.view._arrivals[0] <= came_before_s


class Inbox(list):
    """What has come on a topic."""

    def take(self, timeout_s: float = 0.0) -> None:
        return None

    def drain(self) -> list:
        return list(self)


class Quiet:
    """A bus on which nobody has said anything yet."""

    def __init__(self) -> None:
        self.inboxes: dict[str, Inbox] = {}

    def queue(self, topic: str, size: int = 64) -> Inbox:
        return self.inboxes.setdefault(topic, Inbox())

    latest = queue

    def await_ready(self, *_: object) -> set[str]:
        return set()

    def ask(self, *_: object) -> None:
        return None


@pytest.mark.parametrize(("address", "told"), [("127.0.0.1", True), ("192.0.2.1", False)])
def test_latency_is_told_only_where_clocks_can_be_compared(address: str, told: bool) -> None:
    bus = Quiet()
    Listener(bus, Config(bus=BusConfig(f"tcp/{address}:7447")))
    assert ("tracked" in bus.inboxes) is told


def test_scale_and_state_are_shown_as_they_change_without_any_pose() -> None:
    bus = Quiet()
    listener = Listener(bus, Config())
    assert listener.view.scale is None
    bus.inboxes["scale"].append(SCALE)
    bus.inboxes["status"].append(ros.diagnostics(MS, [("tracking", 0, "lost", {})]))
    assert list(listener.poses(None)) == []
    assert listener.view.scale == pytest.approx(1.5)
    assert listener.view.state == "lost"
    bus.inboxes["status"].append(ros.diagnostics(MS, []))
    assert list(listener.poses(None)) == []
    assert listener.view.state == "lost"


def test_a_table_is_brought_up_to_date_a_few_times_a_second(monkeypatch: pytest.MonkeyPatch) -> None:
    done: list[str] = []
    now = [100.0]

    class Screen:
        def __init__(self, auto_refresh: bool) -> None:
            done.append("opened")

        def start(self) -> None:
            done.append("start")

        def stop(self) -> None:
            done.append("stop")

        def update(self, table: RichTable, refresh: bool = False) -> None:
            assert refresh
            assert table.row_count == len(view.rows(0))
            done.append(f"{now[0]:g}")

    view = LiveView()
    monkeypatch.setattr("rich.live.Live", Screen)
    monkeypatch.setattr(watch, "time", SimpleNamespace(monotonic=lambda: now[0], monotonic_ns=lambda: 0))
    with Table() as table:
        for now[0] in (100.0, 100.1, 100.15, 100.25):
            table.pose(view)
        now[0] = 100.3
        table.moment(view)
    assert done == ["opened", "start", "100", "100.25", "100.3", "stop"]


def test_a_table_shows_that_time_passes_and_is_taken_where_lines_are_not_asked_for(
    endpoint: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    shown: list[str] = []
    monkeypatch.setattr(Table, "pose", lambda self, view: shown.append("pose"))
    monkeypatch.setattr(Table, "moment", lambda self, view: shown.append("moment"))
    assert main(["watch", "--robot", "fake", "--endpoint", endpoint, "--count", "3"]) == 0
    assert shown.count("pose") == 3
    assert shown[-1] == "moment"


def test_records_the_cameras_poses(
    endpoint: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Of a daemon that doesn't say where its camera sits, as this configuration has it."""
    file = tmp_path / "poses.tum"
    arguments = ["--robot", "fake", "--endpoint", endpoint, "--count", "20", "--tum", str(file)]
    assert main(["watch", *arguments]) == 0
    rows = np.loadtxt(file)
    assert rows.shape == (20, 8)
    assert rows[:, 1] == pytest.approx(rows[:, 0])
    # the default camera looks along the robot's x axis
    assert np.abs(rows[:, 4:] - [-0.5, 0.5, -0.5, 0.5]).max() < 1e-9
    assert "frames.base_from_camera of this configuration" in caplog.text


def test_a_stream_that_the_shell_appends_to_a_file_leaves_what_is_there(
    endpoint: str, tmp_path: Path
) -> None:
    file = tmp_path / "poses.tum"
    file.write_text("# of yesterday\n")
    with file.open("a") as shell:
        arguments = ["--robot", "fake", "--endpoint", endpoint, "--count", "3"]
        assert main(["watch", *arguments, "--tum", f"/dev/fd/{shell.fileno()}"]) == 0
    assert file.read_text().startswith("# of yesterday\n")
    assert len(read_tum(file)) == 3


@pytest.mark.parametrize("mounted", [looking_left_from_the_mast()])
@pytest.mark.parametrize("own", [[], ["--set", "frames.base_from_camera_xyz=[9, 9, 9]"]])
def test_records_the_camera_where_the_daemon_has_it(
    endpoint: str, mounted: np.ndarray, own: list[str], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Whatever the watcher's own configuration says, or doesn't."""
    file = tmp_path / "poses.tum"
    arguments = ["--robot", "fake", "--endpoint", endpoint, "--count", "20", "--tum", str(file), *own]
    assert main(["watch", *arguments]) == 0
    recorded = read_tum(file)
    seconds = 1e-9 * recorded.stamps
    np.testing.assert_allclose(recorded.positions - mounted[:3, 3], np.outer(seconds, [1, 0, 0]), atol=1e-8)
    np.testing.assert_allclose(recorded.poses[:, :3, :3], mounted[None, :3, :3].repeat(20, 0), atol=1e-8)
    assert "base_from_camera" not in caplog.text


def test_ctrl_c_ends_it_in_the_background_of_a_script_too() -> None:
    """A shell without job control starts what is in the background with SIGINT ignored."""
    arguments = [sys.executable, "-m", "prism_edge.cli", "watch", "--plain", "--endpoint", free_endpoint()]
    ignoring = "import os, signal, sys; signal.signal(signal.SIGINT, signal.SIG_IGN)"
    start = f"{ignoring}; os.execv(sys.argv[1], sys.argv[1:])"
    with subprocess.Popen(
        [sys.executable, "-c", start, *arguments], stderr=subprocess.PIPE, text=True
    ) as watch:
        assert watch.stderr is not None
        assert "Ctrl-C ends" in watch.stderr.readline()
        watch.send_signal(signal.SIGINT)
        try:
            assert watch.wait(20.0) == 130
        finally:
            watch.kill()


def test_a_place_that_can_not_be_written_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["watch", "--tum", "/proc/nowhere/poses.tum"]) == 3
    said = capsys.readouterr().err
    assert said == "prism-edge: error: /proc/nowhere/poses.tum: there is no folder /proc/nowhere\n"


def test_a_file_without_a_name_is_a_wrong_command_line(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["watch", "--tum", ""])
    assert ended.value.code == 2
    assert "expected a file" in capsys.readouterr().err


def test_an_earlier_recording_is_replaced_only_when_asked(
    endpoint: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "poses.tum"
    file.write_text("an hour's walk\n")
    arguments = ["watch", "--robot", "fake", "--endpoint", endpoint, "--count", "5", "--tum", str(file)]
    assert main(arguments) == 3
    assert "is there already" in capsys.readouterr().err
    assert file.read_text() == "an hour's walk\n"
    assert main([*arguments, "--overwrite"]) == 0
    assert len(read_tum(file)) == 5


def test_a_pipe_and_stdout_are_no_earlier_recordings(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "file").touch()
    streams = [tmp_path / "pipe", *map(Path, ("/dev/stdout", "/dev/null", "/dev/fd/1"))]
    assert [_is_stream(path) for path in streams] == [True] * 4
    assert [_is_stream(tmp_path / name) for name in ("file", "absent", ".")] == [False] * 3


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")
def test_a_disk_that_is_full_is_named(endpoint: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["watch", "--robot", "fake", "--endpoint", endpoint, "--plain", "--tum", "/dev/full"]) == 74
    assert "error: /dev/full: No space left on device\n" in capsys.readouterr().err
