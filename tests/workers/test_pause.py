"""The command `pause`, alone and in a recording that is being played."""

from __future__ import annotations

import threading
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
from sources import tiny_datasets as tiny

from prism_edge.sources import open_source
from prism_edge.workers import pause as module
from prism_edge.workers.pause import Pause
from prism_edge.workers.source import SourceWorker
from tests.waiting import until
from tests.workers.list_bus import ListBus
from tests.workers.source_bench import Recorder, running, settings


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
    assert pause.health == {}
    bus.desk.ask("pause", "on")
    pause.serve()
    assert pause.health == {"warning": "paused by command"}


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
