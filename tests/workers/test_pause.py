"""The command `pause`, alone and in a recording that is being played."""

from __future__ import annotations

import threading
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from sources import tiny_datasets as tiny

from prism_edge.sources import Image, Slot, Source, open_source
from prism_edge.workers import pause as module
from prism_edge.workers import source as source_worker
from prism_edge.workers.pause import Pause
from prism_edge.workers.source import SourceWorker
from tests.waiting import until
from tests.workers.list_bus import ListBus
from tests.workers.source_bench import Recorder, running, settings
from tests.workers.test_source_pace import SlowSource


def test_on_off_and_what_was_so_already() -> None:
    bus = ListBus()
    pause = Pause(bus)  # type: ignore[arg-type]
    for argument in ("on", "on", "off", "off", "maybe"):
        bus.desk.ask("pause", argument)
    pause.serve()
    said = [(reply.ok, reply.said) for reply in bus.desk.replies]
    assert said == [
        (True, "images are held back"),
        (True, "images are held back already"),
        (True, "images go on"),
        (True, "images go on already"),
        (False, "expected on or off, got 'maybe'"),
    ]


def test_health_says_so() -> None:
    bus = ListBus()
    pause = Pause(bus)  # type: ignore[arg-type]
    assert pause.warning == ""
    bus.desk.ask("pause", "on")
    pause.serve()
    assert pause.warning == "paused by command"


def test_hold_lasts_until_images_may_go_on_or_the_process_stops(monkeypatch: pytest.MonkeyPatch) -> None:
    bus, clock = ListBus(), [0]
    own = SimpleNamespace(monotonic_ns=lambda: clock[0], monotonic=time.monotonic)
    monkeypatch.setattr(module, "time", own)
    pause = Pause(bus)  # type: ignore[arg-type]
    assert pause.hold() == 0
    bus.desk.ask("pause", "on")
    looks: list[float] = []

    def wait(seconds: float) -> None:
        """A second goes by, by the test's clock."""
        looks.append(seconds)
        clock[0] += 1_000_000_000
        if len(looks) == 3:
            bus.desk.ask("pause", "off")
        pause.serve()

    with monkeypatch.context() as patch:
        patch.setattr(pause, "wait", wait)
        assert pause.hold() == 3_000_000_000
    bus.desk.ask("pause", "on")
    threading.Timer(0.2, bus.stopped.set).start()
    pause.hold()
    assert bus.stopped.is_set()


def test_a_recording_goes_on_where_it_was_and_skips_nothing(tmp_path: Path) -> None:
    config = settings(tiny.write_tum(tmp_path))
    looks: list[int] = []  # how much had come out, each time that it looked for a command

    def work(bus: Recorder) -> None:
        bus.desk.before_serving = lambda: looks.append(bus.published.qsize())
        bus.desk.ask("pause", "on")
        with open_source(config.source) as source:
            SourceWorker(config, bus, source).run()  # type: ignore[arg-type]

    with running(work) as bus:
        until(lambda: "paused by command" in bus.pulse.values.get("warning", ""), "it says that it pauses")
        so_far = len(looks)
        # over several periods of the recording
        until(lambda: len(looks) >= so_far + 8, "it looks for commands")
        assert not any(looks)
        bus.desk.ask("pause", "off")
        frames, stream = bus.until_end()
    assert len(frames) == stream.released == stream.frames
    assert "warning" not in bus.pulse.values


@pytest.mark.parametrize("why", ["pause", "end"])
def test_while_nothing_goes_out_there_is_no_rate(
    why: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(source_worker, "_STILL_S", 0.3)
    config = settings(tiny.write_tum(tmp_path), rate_hz=50.0, loop=why == "pause")

    def work(bus: Recorder) -> None:
        with open_source(config.source) as source:
            SourceWorker(config, bus, source).run()  # type: ignore[arg-type]

    with running(work) as bus:
        until(lambda: float(bus.pulse.values.get("fps", "0")) > 10.0, "it plays")
        if why == "pause":
            bus.desk.ask("pause", "on")
        until(lambda: bus.pulse.values["fps"] == "0.0", "it stands")


class Guessed(SlowSource):
    """The second image comes a gap after the first, as is known once it is read; then comes a pause."""

    def __init__(self, source: Source, bus: Recorder) -> None:
        super().__init__(source)
        self.frame_count, self.period_ns = 5, 200_000_000
        self._bus, self._last_ns = bus, -self.period_ns

    def peek(self) -> Slot | None:
        return Slot(self._next, self._last_ns + self.period_ns) if self._next < 5 else None

    def read(self) -> Image:
        index, self._next = self._next, self._next + 1
        self._last_ns += self.period_ns * (3 if index == 1 else 1)
        if index == 1:
            self._bus.desk.ask("pause", "on")
        pixels = np.full((self.camera.height, self.camera.width), index, np.uint8)
        return Image(index, self._last_ns, pixels)


@pytest.mark.parametrize("goes_on", [True, False])
def test_an_image_that_was_read_before_its_time_is_held_back_too(goes_on: bool, tmp_path: Path) -> None:
    config = settings(tiny.write_tum(tmp_path), loop=True)

    def work(bus: Recorder) -> None:
        with Guessed(open_source(config.source), bus) as source:
            SourceWorker(config, bus, source).run()  # type: ignore[arg-type]

    with running(work) as bus:
        first = bus.next()[1]
        until(lambda: "paused by command" in bus.pulse.values.get("warning", ""), "it says that it pauses")
        due_ns = first.captured_monotonic_ns + 600_000_000
        until(lambda: time.monotonic_ns() > due_ns + 100_000_000, "its time has come")
        assert bus.published.empty()
        if goes_on:
            bus.desk.ask("pause", "off")
            frames, _ = bus.until_end()
            held_ns = [f.captured_monotonic_ns - first.captured_monotonic_ns - f.stamp_ns for f in frames]
            assert [frame.index for frame in frames] == [1, 2, 3, 4]
            assert held_ns[0] > 0
            assert len(set(held_ns)) == 1
    if not goes_on:
        assert bus.published.empty()
