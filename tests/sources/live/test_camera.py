"""The thread behind every live camera, beside a driver that does what a test says."""

from __future__ import annotations

import logging
import re
import threading
import time

import pytest
from sources.live.bench import CAMERA, DEADLINE_S, QUICK, Bench, picture, steady

from prism_edge.errors import ConfigError, SourceError
from prism_edge.geometry.cameras import Camera
from prism_edge.sources.base import Absent, Image, Unreadable
from prism_edge.sources.checks import UNCALIBRATED
from prism_edge.sources.live.camera import LiveCamera, Timing
from prism_edge.sources.live.driver import CameraLostError, Grab
from tests.waiting import until


def next_image(camera: LiveCamera) -> Image:
    deadline = time.monotonic() + DEADLINE_S
    while time.monotonic() < deadline:
        item = camera.read()
        if isinstance(item, Image):
            return item
    raise AssertionError("no image came")


def test_the_newest_wins_and_gaps_show() -> None:
    more = threading.Event()  # after the first few

    def script(k: int) -> Grab:
        assert k < 3 or more.wait(DEADLINE_S)
        return steady(k)

    bench = Bench(script)
    with LiveCamera(bench, CAMERA, "a test", QUICK) as camera:
        first = next_image(camera)
        more.set()
        until(lambda: bench.grabs > 20)
        later = next_image(camera)
        assert camera.peek() is None
    assert later.index >= 10 > first.index
    assert later.captured_monotonic_ns > first.captured_monotonic_ns
    assert later.stamp_ns - first.stamp_ns == later.captured_monotonic_ns - first.captured_monotonic_ns
    assert abs(later.stamp_ns - time.time_ns()) < DEADLINE_S * 1e9
    assert bench.connects == 1
    until(lambda: bench.closes == 1)  # by the camera's thread, which is not waited for for ever


def test_what_the_camera_lost_counts_into_the_index() -> None:
    def script(k: int) -> Grab | None:
        return Grab(time.monotonic_ns(), picture, missed=4) if k in (1, 2) else None

    bench = Bench(script)
    bench.dead_s = DEADLINE_S  # it gives no more, and what it gave is not to be forgotten for that
    with LiveCamera(bench, CAMERA, "a test", QUICK) as camera:
        assert next_image(camera).index == 4


def test_a_lost_camera_is_said_and_comes_back(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    gone = threading.Event()

    def script(k: int) -> Grab:
        if gone.is_set():
            raise CameraLostError("unplugged")
        return steady(k)

    bench = Bench(script)
    with LiveCamera(bench, CAMERA, "a test", QUICK) as camera:
        before = next_image(camera)
        assert camera.health() == {"camera": "streaming", "reconnects": "0"}
        bench.refusal = CameraLostError("not there")
        gone.set()
        until(lambda: camera.health()["camera"] == "reconnecting: not there")
        assert camera.health()["warning"] == "camera: reconnecting (not there)"
        camera.skip()
        assert isinstance(camera.read(), Absent)
        gone.clear()
        bench.refusal = None
        after = next_image(camera)
        assert camera.health() == {"camera": "streaming", "reconnects": "1"}
        until(lambda: len(caplog.records) >= 2)
        said = [r.getMessage() for r in caplog.records]
    assert after.index > before.index
    assert after.stamp_ns > before.stamp_ns
    assert said == [
        "the bench: lost (unplugged); connecting again until it is back",
        "the bench: images come again",
    ]


def test_images_of_another_size_are_warned_of_until_they_fit() -> None:
    size = [64, 48]

    def script(k: int) -> Grab:
        time.sleep(0.002)
        return Grab(time.monotonic_ns(), lambda: picture(k, *size))

    with LiveCamera(Bench(script), CAMERA, "a test", QUICK) as camera:
        next_image(camera)
        assert "warning" not in camera.health()
        size[:] = [32, 24]  # as after a factory reset
        until(lambda: next_image(camera).pixels.shape[0] == 24)
        assert camera.health()["warning"] == "the camera sends 32x24, its intrinsics are for 64x48"
        size[:] = [64, 48]
        until(lambda: next_image(camera).pixels.shape[0] == 48)
        assert "warning" not in camera.health()


@pytest.mark.parametrize("error", [SourceError("refuses 30 Hz"), RuntimeError("X_LINK_ERROR")])
def test_whatever_a_driver_raises_it_is_tried_again(error: Exception) -> None:
    raised = threading.Event()

    def script(k: int) -> Grab:
        if k == 5 and not raised.is_set():
            raised.set()
            raise error
        return steady(k)

    bench = Bench(script)
    with LiveCamera(bench, CAMERA, "a test", QUICK) as camera:
        until(lambda: bench.connects == 2)
        next_image(camera)


def test_a_connection_that_gives_nothing_is_given_up() -> None:
    silent = threading.Event()
    bench = Bench(lambda k: None if silent.is_set() else steady(k))
    with LiveCamera(bench, CAMERA, "a test", QUICK) as camera:
        next_image(camera)
        silent.set()
        silent_since_s = time.monotonic()
        until(lambda: bench.connects >= 3)  # and again: the new connection gets its time, no more
        (quiet_s,) = re.findall(r"no image for (\d+\.\d) s", camera.health()["camera"])
        # counted from the second connection or a later one, not from the last image
        assert float(quiet_s) < time.monotonic() - silent_since_s - bench.dead_s + 0.1
        silent.clear()
        next_image(camera)


def test_a_driver_that_hangs_is_an_error_not_a_hang() -> None:
    hang = threading.Event()
    go_on = threading.Event()

    def script(k: int) -> Grab:
        if hang.is_set():
            go_on.wait(DEADLINE_S)
        return steady(k)

    timing = Timing(read_s=0.02, hang_s=0.3)
    bench = Bench(script)
    camera = LiveCamera(bench, CAMERA, "a test", timing)
    camera.open()
    try:
        until(lambda: bench.grabs > 2)
        hang.set()
        with pytest.raises(SourceError, match="has not come back"):
            until(lambda: camera.read() is None)
    finally:
        go_on.set()
        camera.close()


def test_an_attempt_to_connect_may_take_as_long_as_the_driver_says() -> None:
    class Slow(Bench):
        attempts = 0

        def connect(self) -> Bench:
            if self.refusal is not None:
                time.sleep(0.5)
                self.attempts += 1
            return super().connect()

    gone = threading.Event()

    def script(k: int) -> Grab:
        if gone.is_set():
            raise CameraLostError("unplugged")
        return steady(k)

    bench = Slow(script)
    bench.connect_s = DEADLINE_S
    timing = Timing(first_pause_s=0.01, longest_pause_s=0.01, hang_s=0.2, read_s=0.02)
    with LiveCamera(bench, CAMERA, "a test", timing) as camera:
        next_image(camera)
        bench.refusal = CameraLostError("silent")
        gone.set()
        until(lambda: isinstance(camera.read(), Absent) and bench.attempts >= 2)


def test_a_camera_that_comes_late_is_waited_for(caplog: pytest.LogCaptureFixture) -> None:
    class Late(Bench):
        refused = 0

        def connect(self) -> Bench:
            self.refused += 1
            self.refusal = CameraLostError("not there") if self.refused <= 3 else None
            return super().connect()

    timing = Timing(absent_s=DEADLINE_S, first_pause_s=0.01)
    with LiveCamera(Late(steady), CAMERA, "a test", timing) as camera:
        next_image(camera)
    assert caplog.text.count("not there") == 1


def test_a_camera_that_is_there_before_its_images_is_waited_for() -> None:
    """One that is stuck: only a connection made anew gives images."""
    bench = Bench(lambda k: steady(k) if bench.connects >= 3 else None)
    with LiveCamera(bench, CAMERA, "a test", Timing(absent_s=DEADLINE_S, first_pause_s=0.01)) as camera:
        next_image(camera)
        assert (bench.connects, bench.closes) == (3, 2)


def test_a_camera_that_never_comes_is_an_error() -> None:
    bench = Bench(steady)
    bench.refusal = CameraLostError("not there")
    with pytest.raises(SourceError, match="the bench: not there"):
        LiveCamera(bench, CAMERA, "a test", QUICK).open()
    bench.refusal = SourceError("no permission")  # waiting won't help: at once
    with pytest.raises(SourceError, match="no permission"):
        LiveCamera(bench, CAMERA, "a test", Timing(absent_s=3600.0)).open()


def test_images_must_fit_the_intrinsics() -> None:
    bench = Bench(lambda k: Grab(time.monotonic_ns(), lambda: picture(0, 32, 24)))
    with pytest.raises(ConfigError, match="64x48"):
        LiveCamera(bench, CAMERA, "a test", QUICK).open()
    assert bench.closes == 1
    with LiveCamera(bench, UNCALIBRATED, "none", QUICK) as camera:
        assert next_image(camera).pixels.shape == (24, 32, 3)


def test_an_opening_that_was_held_up_looks_for_an_image_all_the_same() -> None:
    bench = Bench(steady)
    bench.dead_s, bench.period_ns = 0.0, 0
    with LiveCamera(bench, CAMERA, "a test", QUICK) as camera:
        next_image(camera)


def test_no_readable_image_is_an_error_when_opening() -> None:
    with pytest.raises(SourceError, match="is damaged"):
        LiveCamera(Bench(lambda k: Grab(0, lambda: "is damaged")), CAMERA, "a test", QUICK).open()
    with pytest.raises(SourceError, match="no image came"):
        LiveCamera(Bench(lambda k: None), CAMERA, "a test", QUICK).open()


def test_intrinsics_may_be_the_cameras_own() -> None:
    bench = Bench(steady)
    bench.intrinsics = CAMERA
    with LiveCamera(bench, None, "factory", QUICK) as camera:
        assert camera.camera == CAMERA
    with pytest.raises(ConfigError, match="prism-edge calibrate"):
        LiveCamera(Bench(steady), None, "factory", QUICK).open()
    with LiveCamera(bench, Camera(64, 48, 50.0, 50.0, 32.0, 24.0), "a file", QUICK) as camera:
        assert camera.camera.fx == 50.0


def test_damaged_images_are_unreadable_and_reported() -> None:
    def script(k: int) -> Grab:
        time.sleep(0.002)
        return Grab(time.monotonic_ns(), (lambda: "is cut short") if k > 3 else picture)

    with LiveCamera(Bench(script), CAMERA, "a test", QUICK) as camera:
        until(lambda: "warning" in (camera.read() and camera.health()))
        assert "damaged images" in camera.health()["warning"]
        assert camera.health()["camera"] == "streaming"
        until(lambda: isinstance(camera.read(), Unreadable))


def test_it_opens_again_after_closing() -> None:
    bench = Bench(steady)
    camera = LiveCamera(bench, CAMERA, "a test", QUICK)
    for _ in range(2):
        with camera:
            next_image(camera)
        until(lambda: bench.closes == bench.connects)  # by the thread that had it
    assert bench.connects == 2


def test_where_there_is_no_memory_the_camera_is_not_said_to_be_lost() -> None:
    """The lock that reading waits for may never be given back: that ends the process (vital.py)."""

    def script(k: int) -> Grab:
        camera._closing.set()  # else it would go on for ever
        raise MemoryError

    bench = Bench(script)
    camera = LiveCamera(bench, CAMERA, "a test", QUICK)
    with pytest.raises(MemoryError):
        camera._run(bench.connect())
    assert camera.health()["camera"] == "streaming"


def test_a_driver_that_hangs_is_warned_of_meanwhile() -> None:
    hang = threading.Event()

    def script(n: int) -> Grab | None:
        if n > 3:
            hang.wait(30)
        return steady(n)

    with LiveCamera(Bench(script), CAMERA, "test", QUICK) as camera:
        until(lambda: bool(camera.read()) and "warning" in camera.health())
        assert camera.health()["warning"] == "camera: no image comes", "not another one each second"
        assert "no image for" in camera.health()["camera"]
        hang.set()
        until(lambda: isinstance(camera.read(), Image) and "warning" not in camera.health())
