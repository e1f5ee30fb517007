"""Linux cameras, against a driver in miniature that does what real ones are known for."""

from __future__ import annotations

import errno
import os
import time

import cv2
import numpy as np
import pytest
from sources.live.fake_v4l2 import FakeCamera

from prism_edge.errors import ConfigError, SourceError
from prism_edge.geometry.cameras import Camera
from prism_edge.sources.base import Image, Unreadable
from prism_edge.sources.checks import UNCALIBRATED
from prism_edge.sources.live import v4l2_abi as abi
from prism_edge.sources.live.camera import LiveCamera, Timing
from prism_edge.sources.live.driver import CameraLostError
from prism_edge.sources.live.v4l2 import V4l2Driver
from tests.waiting import until

PATH = FakeCamera.path
QUICK = Timing(absent_s=0.0, first_pause_s=0.01, longest_pause_s=0.02, read_s=0.05)


def driver(fake: FakeCamera, query: str = "", camera: Camera | None = None) -> V4l2Driver:
    return V4l2Driver(f"v4l2:{PATH}?{query}" if query else f"v4l2:{PATH}", camera, fake)  # type: ignore[arg-type]


def source(fake: FakeCamera, query: str = "width=64&height=48") -> LiveCamera:
    return LiveCamera(driver(fake, query), UNCALIBRATED, "none", QUICK)


def image(camera: LiveCamera) -> Image:
    found: list[Image] = []
    until(lambda: isinstance(item := camera.read(), Image) and not found.append(item))
    return found[0]


def test_images_come_with_the_kernels_stamps() -> None:
    fake = FakeCamera()
    connection = driver(fake, "width=64&height=48").connect()
    grab = connection.grab()
    assert grab is not None
    assert grab.captured_ns == fake.exposed_ns
    pixels = grab.decode()
    assert isinstance(pixels, np.ndarray)
    assert pixels.shape == (48, 64, 3)
    connection.close()
    assert (fake.opened, fake.closed, fake.mapped) == (1, 1, 0)


@pytest.mark.parametrize(("fields", "warned"), [(0, False), (1, False), (2, False), (4, True), (9, True)])
def test_interlaced_images_are_warned_of(
    fields: int, warned: bool, caplog: pytest.LogCaptureFixture
) -> None:
    """A grabber for analogue cameras gives what it has, whatever field order it is asked for."""
    driver(FakeCamera(fields=fields), "width=64&height=48").connect().close()
    assert ("is interlaced" in caplog.text) is warned


@pytest.mark.parametrize(("flags", "shift_ns"), [(0, 0), (0x4000, 0), (0x2000, -10**13), (0x2000, 10**10)])
def test_stamps_of_another_clock_are_not_believed(flags: int, shift_ns: int) -> None:
    fake = FakeCamera(stamp_flags=flags, stamp_shift_ns=shift_ns)
    connection = driver(fake, "width=64&height=48").connect()
    grab = connection.grab()
    assert grab is not None
    assert fake.exposed_ns < grab.captured_ns <= time.monotonic_ns()


def test_a_known_delay_is_taken_off() -> None:
    fake = FakeCamera()
    grab = driver(fake, "width=64&height=48&delay_ms=12.5").connect().grab()
    assert grab is not None
    assert grab.captured_ns == fake.exposed_ns - 12_500_000


def test_size_follows_the_camera_file() -> None:
    fake = FakeCamera()
    connected = driver(fake, camera=Camera(128, 96, 100.0, 100.0, 63.5, 47.5))
    connected.connect()
    # YUYV has that size at 5 Hz only: the format that has the usual rate is taken
    assert connected.name == f"camera {PATH} (Acme Cam, MJPG 128x96)"
    assert connected.period_ns == pytest.approx(1e9 / 30)


def test_without_a_rate_asked_for_the_fastest_will_do() -> None:
    fake = FakeCamera(modes={"YUYV": {(64, 48): 10.0}, "UYVY": {(64, 48): 15.0}})
    connected = driver(fake, "width=64&height=48")
    connected.connect()
    assert "UYVY" in connected.name
    assert connected.period_ns == pytest.approx(1e9 / 15)


def test_without_a_size_the_camera_keeps_its_own() -> None:
    fake = FakeCamera()
    connected = driver(fake, "format=YUYV")
    connected.connect()
    assert "YUYV 128x96" in connected.name


@pytest.mark.parametrize(
    ("query", "words"),
    [
        ("width=640&height=480", "refuses 640x480; it made of it: YUYV 128x96 at 5 Hz; MJPG 128x96 at 30 Hz"),
        ("width=128&height=96&rate=60", "refuses 128x96 at 60 Hz"),
        ("width=128&height=96&format=YUYV&rate=30", "YUYV 128x96 at 5 Hz"),
        ("width=64&height=48&format=NV12", "YUYV, MJPG, not NV12"),
        ("width=64&height=48&gain=500", "gain from 0 to 100"),
        ("width=64&height=48&exposure_ms=1000", "exposure from 0.3 to 204.7"),
        ("width=64&height=48&focus=3", "no setting for focus"),
    ],
)
def test_what_the_camera_can_not_do_is_refused(query: str, words: str) -> None:
    fake = FakeCamera()
    with pytest.raises(SourceError) as error:
        driver(fake, query).connect()
    assert words in str(error.value)
    assert fake.closed == fake.opened == 1


def test_settings_are_made() -> None:
    fake = FakeCamera()
    driver(fake, "width=64&height=48&gain=7&exposure_ms=8").connect()
    assert fake.controls[abi.CID_GAIN][2] == 7
    assert fake.controls[abi.CID_EXPOSURE_ABSOLUTE][2] == 80
    assert fake.controls[abi.CID_EXPOSURE_AUTO][2] == abi.EXPOSURE_MANUAL
    assert fake.controls[abi.CID_EXPOSURE_AUTO_PRIORITY][2] == 0  # the dark must not lower the rate
    # What another program left behind is undone where nothing is asked for.
    driver(fake, "width=64&height=48").connect()
    assert fake.controls[abi.CID_EXPOSURE_AUTO][2] == abi.EXPOSURE_APERTURE_PRIORITY


def test_settings_that_are_accepted_and_ignored_are_found_out() -> None:
    for control, query, words in (
        (abi.CID_GAIN, "gain=7", "gain 50 though it was set to 7"),
        (abi.CID_EXPOSURE_ABSOLUTE, "exposure_ms=8", "exposure 25 though it was set to 8"),
        (abi.CID_EXPOSURE_AUTO, "exposure_ms=8", "stays in automatic"),
    ):
        fake = FakeCamera(stubborn={control})
        with pytest.raises(SourceError, match=words):
            driver(fake, f"width=64&height=48&{query}").connect()
        assert (fake.closed, fake.mapped) == (1, 0)


def test_settings_that_fall_back_once_images_flow_are_found_out() -> None:
    fake = FakeCamera(resets_on_stream={abi.CID_EXPOSURE_ABSOLUTE: 250})
    with pytest.raises(SourceError, match="exposure 25"):
        driver(fake, "width=64&height=48&exposure_ms=8").connect()


def test_a_mode_that_changes_once_images_flow_is_found_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """As of a camera on too slow a bus, whose driver falls back to fewer images."""
    fake = FakeCamera()
    begin = fake._streamon

    def slower(argument: object) -> None:
        begin(argument)
        fake._rate = 15.0

    monkeypatch.setattr(fake, "_streamon", slower)
    with pytest.raises(SourceError, match=r"changed its mode from .*30.* to .*15.* by itself"):
        driver(fake, "width=64&height=48").connect()
    assert (fake.closed, fake.mapped) == (1, 0)


def test_a_camera_that_breaks_when_its_rate_is_set_is_lost_in_words(monkeypatch: pytest.MonkeyPatch) -> None:
    fake = FakeCamera()
    monkeypatch.setattr(fake, "_s_parm", lambda _: fake._fail(errno.EIO))
    with pytest.raises(CameraLostError, match="setting the rate fails"):
        driver(fake, "width=64&height=48&rate=15").connect()
    assert (fake.closed, fake.mapped) == (1, 0)


def test_unplugged_and_back_by_its_stable_path() -> None:
    fake = FakeCamera()
    with source(fake) as camera:
        before = image(camera)
        fake.unplug()
        until(lambda: camera.health()["camera"].startswith("reconnecting"))
        assert "is not there" in camera.health()["camera"] or "unplugged" in camera.health()["camera"]
        fake.plugged = True
        until(lambda: camera.health()["camera"] == "streaming")
        after = image(camera)
    assert after.index > before.index
    assert after.captured_monotonic_ns > before.captured_monotonic_ns
    assert fake.closed == fake.opened == 2
    assert fake.mapped == 0


def test_another_camera_in_its_place_is_not_taken() -> None:
    fake = FakeCamera()
    with source(fake) as camera:
        image(camera)
        fake.unplug()
        fake.card, fake.plugged = "Other Cam", True
        until(lambda: "another camera, Other Cam" in camera.health()["camera"])
        fake.card = "Acme Cam"
        until(lambda: camera.health()["camera"] == "streaming")


def test_a_camera_that_comes_back_in_another_mode_is_not_taken() -> None:
    fake = FakeCamera()
    with source(fake) as camera:
        image(camera)
        fake.unplug()
        fake.modes, fake.plugged = {"YUYV": {(32, 24): 30.0}}, True
        until(lambda: "refuses 64x48" in camera.health()["camera"])


def test_a_camera_that_gives_nothing_is_opened_again() -> None:
    fake = FakeCamera()
    with source(fake, "width=64&height=48&timeout=0.2") as camera:
        image(camera)
        fake.silent = True
        until(lambda: fake.opened >= 3)
        fake.silent = False
        until(lambda: camera.health()["camera"] == "streaming")


def test_images_that_the_kernel_lost_show_as_gaps() -> None:
    fake = FakeCamera()
    connection = driver(fake, "width=64&height=48").connect()
    missed = []
    for fake.skip in (0, 3):
        grab = connection.grab()
        assert grab is not None
        missed.append(grab.missed)
    assert missed == [0, 3]


def test_damaged_images_are_unreadable() -> None:
    fake = FakeCamera()
    with source(fake) as camera:
        image(camera)
        fake.flags = abi.BUF_FLAG_ERROR
        until(lambda: isinstance(item := camera.read(), Unreadable) and "bus" in item.reason)
        fake.flags, fake.frame = 0, b"\1" * 1000
        until(lambda: isinstance(item := camera.read(), Unreadable) and "cut short" in item.reason)


def test_mjpg_is_decoded() -> None:
    scene = cv2.resize(np.arange(12, dtype=np.uint8).reshape(3, 4) * 20, (128, 96))
    fake = FakeCamera(frame=cv2.imencode(".jpg", scene)[1].tobytes())
    grab = driver(fake, "width=128&height=96&format=MJPG").connect().grab()
    assert grab is not None
    decoded = grab.decode()
    assert isinstance(decoded, np.ndarray)
    assert np.abs(decoded.astype(int) - scene).mean() < 3


def test_a_driver_that_only_one_program_may_open_is_in_use(monkeypatch: pytest.MonkeyPatch) -> None:
    def held(_: FakeCamera, path: str) -> int:
        raise OSError(errno.EBUSY, os.strerror(errno.EBUSY), path)

    monkeypatch.setattr(FakeCamera, "open", held)
    with pytest.raises(CameraLostError, match="video-index0 is in use by another program"):
        driver(FakeCamera()).connect()


@pytest.mark.parametrize(
    ("fault", "error", "words"),
    [
        ({"plugged": False}, CameraLostError, "is not there"),
        ({"busy": True}, CameraLostError, "in use by another program"),
        ({"allowed": False}, SourceError, "group video"),
        ({"capabilities": 0}, SourceError, "no video device"),
        ({"capabilities": abi.CAP_STREAMING}, SourceError, "takes no pictures"),
        ({"capabilities": abi.CAP_STREAMING | abi.CAP_VIDEO_CAPTURE_MPLANE}, SourceError, "multi-planar"),
        ({"stream_error": errno.ENOSPC}, SourceError, "USB bus"),
        ({"stream_error": errno.EIO}, CameraLostError, "starting the stream fails"),
        ({"stream_error": errno.EBUSY}, CameraLostError, "in use by another program"),
        ({"modes": {"H264": {(64, 48): 30.0}}}, SourceError, "H264"),
    ],
)
def test_what_is_wrong_is_one_line(fault: dict, error: type[Exception], words: str) -> None:
    fake = FakeCamera(**fault)
    with pytest.raises(error, match=words) as raised:
        driver(fake, "width=64&height=48").connect()
    assert "\n" not in str(raised.value)
    assert fake.closed == fake.opened


@pytest.mark.parametrize(
    ("uri", "words"),
    [
        ("v4l2:", "by its path"),
        ("v4l2:video0", "by its path"),
        ("v4l2:/dev/video0?width=640", "go together"),
        ("v4l2:/dev/video0?widht=640", "did you mean width"),
        ("v4l2:/dev/video0?rate=fast", "a number"),
        ("v4l2:/dev/video0?format=H264", "YUYV"),
        ("v4l2:/dev/video0?exposure_ms=-1", "between 0 and"),
    ],
)
def test_wrong_addresses_are_one_line(uri: str, words: str) -> None:
    with pytest.raises(SourceError, match=words):
        V4l2Driver(uri)


def test_an_address_must_not_contradict_the_camera_file() -> None:
    with pytest.raises(ConfigError, match="asks for 64x48, but the camera file is for 128x96"):
        V4l2Driver("v4l2:/dev/video0?width=64&height=48", Camera(128, 96, 100.0, 100.0, 63.5, 47.5))


def test_replugged_it_gets_the_size_that_it_had_though_nobody_named_one() -> None:
    fake = FakeCamera(modes={"YUYV": {(64, 48): 30.0, (128, 96): 30.0}}, _pix=(64, 48, "YUYV"))
    again = driver(fake)
    again.connect().close()
    fake._pix = (128, 96, "YUYV")  # its own default
    grab = again.connect().grab()
    assert grab is not None
    assert grab.decode().shape == (48, 64, 3)  # type: ignore[union-attr]


@pytest.mark.parametrize("fields", [5, 6])
def test_two_half_pictures_are_no_picture(fields: int) -> None:
    with pytest.raises(SourceError, match="one above the other"):
        driver(FakeCamera(fields=fields), "width=64&height=48").connect()
