"""The source worker beside a live camera: what goes out, and what is said when the camera goes away."""

from __future__ import annotations

import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from sources.live.bench import CAMERA, QUICK, Bench, steady

from prism_edge.config import Config, SourceConfig
from prism_edge.errors import ConfigError
from prism_edge.messages import Frame, Tracked
from prism_edge.sources.live import wall_clock
from prism_edge.sources.live.camera import LiveCamera
from prism_edge.sources.live.driver import CameraLostError, Grab
from prism_edge.workers import source as source_worker
from prism_edge.workers.source import SourceWorker, main
from tests.waiting import until
from tests.workers.source_bench import Recorder, running

CONFIG = Config(source=SourceConfig(uri="a camera", peers_s=0.0))


def working(bench: Bench):  # type: ignore[no-untyped-def]
    def work(bus: Recorder) -> None:
        with LiveCamera(bench, CAMERA, "a test", QUICK) as camera:
            SourceWorker(CONFIG, bus, camera).run()  # type: ignore[arg-type]

    return work


def test_frames_carry_the_cameras_times() -> None:
    taken: list[int] = []

    def script(k: int) -> Grab:
        grab = steady(k)
        taken.append(grab.captured_ns)
        return grab

    with running(working(Bench(script))) as bus:
        frames = [bus.next()[1] for _ in range(5)]
        until(lambda: bus.pulse.values["camera"] == "streaming")
    assert {frame.captured_monotonic_ns for frame in frames} <= set(taken)
    assert abs(frames[0].stamp_ns - time.time_ns()) < 60e9
    assert [frame.index for frame in frames] == sorted({frame.index for frame in frames})


def test_what_was_replaced_by_something_newer_is_counted_as_skipped() -> None:
    def script(k: int) -> Grab:
        grab = steady(k)
        return Grab(grab.captured_ns, grab.decode, missed=2)

    with running(working(Bench(script))) as bus:
        frames = [bus.next()[1] for _ in range(5)]
        until(lambda: int(bus.pulse.values["skipped"]) >= frames[-1].index - 4)
        assert "ended" not in bus.states


def test_a_lost_camera_shows_on_health_and_the_worker_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(source_worker, "_STILL_S", 0.05)
    gone = threading.Event()

    def script(k: int) -> Grab:
        if gone.is_set():
            raise CameraLostError("unplugged")
        return steady(k)

    bench = Bench(script)
    with running(working(bench)) as bus:
        bus.next()
        bench.refusal = CameraLostError("not there")
        gone.set()
        until(lambda: bus.pulse.values.get("warning") == "camera: reconnecting (not there)")
        until(lambda: bus.pulse.values["camera"] == "reconnecting: not there")
        until(lambda: bus.pulse.values["fps"] == "0.0")
        bench.refusal = None
        gone.clear()
        until(lambda: "warning" not in bus.pulse.values)
        until(lambda: bus.pulse.values["camera"] == "streaming")
        until(lambda: bus.pulse.values["reconnects"] == "1")
        while not bus.published.empty():
            bus.next()
        bus.next()


def test_a_source_started_again_goes_on_counting_even_if_the_clock_was_set_back() -> None:
    future_ns = time.time_ns() + 3600 * 10**9

    def work(bus: Recorder) -> None:
        bus.life = 1
        last = Tracked(41, future_ns, 0, "ok", True, -1, 3, np.eye(4))
        # A busy machine's tracker takes three seconds to say it.
        slow = {"tracked": last}
        bus.ask = lambda topic, timeout_s=1.0: slow.get(topic) if timeout_s > 3.0 else None  # type: ignore[attr-defined]
        working(Bench(steady))(bus)

    with running(work) as bus:
        frames = [bus.next()[1] for _ in range(3)]
    assert frames[0].index >= 42
    assert frames[0].stamp_ns > future_ns
    steps = {frame.stamp_ns - frame.captured_monotonic_ns for frame in frames}
    assert len(steps) == 1


@pytest.mark.parametrize("set_by_s", [0, 36_000, -5, -3600])
@pytest.mark.parametrize("tracker_died", [False, True])
def test_a_clock_that_was_set_while_a_source_was_away_moves_no_stamp(
    set_by_s: int, tracker_died: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Hours that a stamp leaps are a way nobody knows; and a gap that becomes a period, one of 27 m/s."""

    def life(number: int, tracked: Tracked | None) -> list[Frame]:
        def work(bus: Recorder) -> None:
            bus.life, bus.run_directory = number, tmp_path
            bus.ask = lambda topic, timeout_s=1.0: tracked if topic == "tracked" else None  # type: ignore[attr-defined]
            working(Bench(steady))(bus)

        with running(work) as bus:
            frames = [bus.next()[1] for _ in range(5)]
        while not bus.published.empty():  # what went out before it had stopped
            frames.append(bus.next()[1])
        return [frame for frame in frames if isinstance(frame, Frame)]

    before = life(0, None)
    last = before[-1]
    now = time.time_ns
    monkeypatch.setattr(wall_clock.time, "time_ns", lambda: now() + set_by_s * 10**9)
    tracked = Tracked(last.index - 2, last.stamp_ns - 10**9, 0, "ok", True, -1, 3, np.eye(4))
    after = life(1, None if tracker_died else tracked)
    assert after[0].index > last.index, "no number comes twice"
    true_gap_ns = after[0].captured_monotonic_ns - last.captured_monotonic_ns
    assert after[0].stamp_ns - last.stamp_ns == pytest.approx(true_gap_ns, abs=2e6)
    assert len({frame.stamp_ns - frame.captured_monotonic_ns for frame in after}) == 1


def test_images_that_a_pause_holds_back_are_no_dropped_ones() -> None:
    """Numbers go on where they were: a gap would count as images that nobody could take."""
    with running(working(Bench(steady))) as bus:
        before = [bus.next()[1] for _ in range(3)][-1]
        bus.desk.ask("pause", "on")
        until(lambda: bus.pulse.values.get("warning") == "paused by command")
        while not bus.published.empty():
            before = bus.next()[1]
        until(lambda: time.monotonic_ns() - before.captured_monotonic_ns > 100_000_000)  # a hundred of them
        bus.desk.ask("pause", "off")
        after = bus.next()[1]
        skipped = int(bus.pulse.values["skipped"])
    assert after.captured_monotonic_ns - before.captured_monotonic_ns > 100_000_000
    assert 1 <= after.index - before.index <= 1 + skipped


def test_being_stopped_ends_the_wait_for_a_camera(tmp_path: Path) -> None:
    file = tmp_path / "camera.yaml"
    file.write_text("width: 64\nheight: 48\nfx: 60\nfy: 60\ncx: 31.5\ncy: 23.5\n")
    uri = f"v4l2:{tmp_path}/video0"
    config = replace(CONFIG, source=SourceConfig(uri=uri, camera=str(file), absent_s=45.0))
    with running(lambda bus: main(config, bus)) as bus:  # type: ignore[arg-type]
        until(lambda: "working" in bus.states)
    # `running` has stopped it, and seen that it ended soon and without an error.
    assert "ready" not in bus.states


def test_a_camera_with_more_patience_gets_more_time_to_be_opened(tmp_path: Path) -> None:
    """The last attempt begins when the time for an absent camera is nearly over."""
    file = tmp_path / "camera.yaml"
    file.write_text("width: 64\nheight: 48\nfx: 60\nfy: 60\ncx: 31.5\ncy: 23.5\n")

    def opened(uri: str) -> float:
        bus = Recorder()
        bus.stopped.set()
        main(replace(CONFIG, source=SourceConfig(uri=uri, camera=str(file))), bus)  # type: ignore[arg-type]
        return bus.budgets["opening the camera"]

    pytest.importorskip("av")
    at_once = "rtsp://127.0.0.1:9/x#timeout="
    assert opened(f"{at_once}60") - opened(f"{at_once}10") == pytest.approx(3 * 50.0)
    assert opened(f"{at_once}60") > 45.0 + 3 * 60.0


@pytest.mark.parametrize(
    ("config", "words"),
    [
        (Config(mode="lockstep", source=SourceConfig(uri="rtsp://127.0.0.1/x", camera="CAMERA")), "lockstep"),
        (Config(source=SourceConfig(uri="rtsp://127.0.0.1/x", camera="CAMERA", loop=True)), "source.loop"),
        (Config(source=SourceConfig(uri="rtsp://127.0.0.1/x", camera="CAMERA", rate_hz=5)), "source.rate_hz"),
        (Config(source=SourceConfig(uri="rtsp://127.0.0.1/x")), "prism-edge calibrate"),
    ],
)
def test_settings_that_make_no_sense_for_a_camera(tmp_path: Path, config: Config, words: str) -> None:
    if config.source.camera:
        file = tmp_path / "camera.yaml"
        file.write_text("width: 64\nheight: 48\nfx: 60\nfy: 60\ncx: 31.5\ncy: 23.5\n")
        config = replace(config, source=replace(config.source, camera=str(file)))
    bus = Recorder()
    with pytest.raises(ConfigError, match=words):
        main(config, bus)  # type: ignore[arg-type]
    assert "ready" not in bus.states
