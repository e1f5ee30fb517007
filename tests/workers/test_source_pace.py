"""The source worker beside a source that is slow or live."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from sources import tiny_datasets as tiny

from prism_edge.messages import EndOfStream, Frame
from prism_edge.sources import Image, Slot, Source, open_source
from prism_edge.workers.source import SourceWorker
from tests.workers.source_bench import Recorder, running, settings


class SlowSource(Source):
    """Images a millisecond apart, of which the first takes a hundred to read."""

    def __init__(self, source: Source) -> None:
        self._inner = source
        self.name, self.camera, self.camera_origin = "slow", source.camera, ""
        self.frame_count, self.period_ns = 50, 1_000_000
        self._next = 0
        self.asked: list[int] = []  # what came next whenever it was asked to read ahead

    def open(self) -> None:
        self._inner.open()

    def peek(self) -> Slot | None:
        return Slot(self._next, self._next * 1_000_000) if self._next < 50 else None

    def read(self) -> Image:
        item = self._inner.read()
        assert isinstance(item, Image)
        if self._next == 0:
            time.sleep(0.1)
        index, self._next = self._next, self._next + 1
        return Image(index, index * 1_000_000, np.roll(item.pixels, index, axis=1))

    def skip(self) -> bool:
        self._next += 1
        return self._next <= 50

    def read_ahead(self) -> None:
        self.asked.append(self._next)

    def close(self) -> None:
        self._inner.close()


def played(folder: Path, slow: type[SlowSource]) -> tuple[list[Frame], EndOfStream, int]:
    """What the worker makes of a slow source: its frames, its end and how many it skipped."""
    config = settings(folder, loop=True)

    def work(bus: Recorder) -> None:
        with slow(open_source(config.source)) as source:
            SourceWorker(config, bus, source).run()  # type: ignore[arg-type]

    with running(work) as bus:
        frames, end = bus.until_end()
        return frames, end, int(bus.pulse.values["skipped"])


def test_a_late_source_skips_and_counts(tmp_path: Path) -> None:
    frames, end, skipped = played(tiny.write_tum(tmp_path), SlowSource)
    assert end.frames == 50
    assert skipped == 50 - len(frames) > 0
    for frame in frames:  # none of those that went out was late by more than a period when it was read
        assert frame.captured_monotonic_ns - frames[0].captured_monotonic_ns == frame.stamp_ns


class Surprised(SlowSource):
    """Learns of its end by going there, as a video does."""

    def peek(self) -> Slot | None:
        return Slot(self._next, self._next * 1_000_000) if self._next <= 50 else None


def test_the_end_is_no_frame_that_was_skipped(tmp_path: Path) -> None:
    frames, end, skipped = played(tiny.write_tum(tmp_path), Surprised)
    assert skipped == 50 - len(frames)
    assert end.frames == 50


class Punctual(Surprised):
    """At its last image, and in time."""

    def __init__(self, source: Source) -> None:
        super().__init__(source)
        self.period_ns, self._next = 1_000_000_000, 49

    def read(self) -> Image | None:  # type: ignore[override]
        return super().read() if self._next < 50 else None


def test_an_end_that_comes_as_a_surprise_is_one_though_nothing_is_late(tmp_path: Path) -> None:
    frames, end, skipped = played(tiny.write_tum(tmp_path), Punctual)
    assert (end.frames, [frame.index for frame in frames], skipped) == (1, [49], 0)


def test_what_follows_is_asked_for_before_the_wait_for_it(tmp_path: Path) -> None:
    config = settings(tiny.write_tum(tmp_path), loop=True)
    sources: list[SlowSource] = []

    def work(bus: Recorder) -> None:
        with SlowSource(open_source(config.source)) as source:
            sources.append(source)
            SourceWorker(config, bus, source).run()  # type: ignore[arg-type]

    with running(work) as bus:
        bus.until_end()
    assert sources[0].asked == list(range(50))


class Heavy(SlowSource):
    """A thousand images a second, each of which takes three milliseconds of the test's own clock."""

    decodes_skipped = True

    def __init__(self, source: Source) -> None:
        super().__init__(source)
        self.now_ns = 0

    def read(self) -> Image:
        self.now_ns += 3_000_000
        return replace(self.image, index=self._passed(), stamp_ns=(self._next - 1) * 1_000_000)

    def skip(self) -> bool:
        self.now_ns += 3_000_000
        return self._passed() < 50

    def open(self) -> None:
        super().open()
        image = self._inner.read()
        assert isinstance(image, Image)
        self.image = image

    def _passed(self) -> int:
        self._next += 1
        return self._next - 1


@pytest.mark.parametrize("decodes_skipped", [True, False])
def test_a_video_that_decodes_slowly_is_played_slower(
    tmp_path: Path,
    decodes_skipped: bool,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    config = settings(tiny.write_tum(tmp_path), loop=True)
    with Heavy(open_source(config.source)) as source:
        source.decodes_skipped = decodes_skipped
        clock = SimpleNamespace(monotonic_ns=lambda: source.now_ns, monotonic=lambda: source.now_ns / 1e9)
        monkeypatch.setattr("prism_edge.workers.source.time", clock)
        with running(lambda bus: SourceWorker(config, bus, source).run()) as bus:  # type: ignore[arg-type]
            frames, end = bus.until_end()
    indices = [frame.index for frame in frames]
    # ten were skipped before it was known to be of no use; of a folder's images, all that were late
    assert indices == ([0, *range(11, 50)] if decodes_skipped else [0])
    assert end.frames == 50
    assert caplog.text.count("it is played slower") == decodes_skipped
    captured = [frame.captured_monotonic_ns for frame in frames]
    assert captured == sorted(captured)


class Camera(SlowSource):
    """A live source: only reading tells when an image is there."""

    live = True

    def peek(self) -> None:
        return None

    def read(self) -> Image | None:  # type: ignore[override]
        return super().read() if self._next < 3 else None


def test_a_live_source_stamps_on_arrival(tmp_path: Path) -> None:
    config = settings(tiny.write_tum(tmp_path), loop=True)

    def work(bus: Recorder) -> None:
        with Camera(open_source(config.source)) as source:
            SourceWorker(config, bus, source).run()  # type: ignore[arg-type]

    before = time.monotonic_ns()
    with running(work) as bus:
        frames, end = bus.until_end()
    captured = [frame.captured_monotonic_ns for frame in frames]
    assert before < captured[0] < captured[1] < captured[2] < time.monotonic_ns()
    assert end.released == 3
