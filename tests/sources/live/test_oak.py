"""OAK cameras at depthai's border: settings, stamps, factory intrinsics, and the link that breaks."""

from __future__ import annotations

import subprocess
import sys
import time
from datetime import timedelta

import numpy as np
import pytest
from sources.live.fake_depthai import FakeDepthai, Unit

from prism_edge.config import SourceConfig
from prism_edge.errors import ConfigError, SourceError
from prism_edge.geometry.cameras import Camera
from prism_edge.sources.base import Image, Unreadable
from prism_edge.sources.live import oak
from prism_edge.sources.live.camera import LiveCamera, Timing
from prism_edge.sources.live.driver import CameraLostError
from prism_edge.sources.live.oak import OakDriver
from prism_edge.sources.open import open_source
from tests.waiting import until

QUICK = Timing(absent_s=0.0, first_pause_s=0.01, longest_pause_s=0.02, read_s=0.05)


@pytest.fixture
def unit(monkeypatch: pytest.MonkeyPatch) -> Unit:
    unit = Unit()
    plug(monkeypatch, unit)
    return unit


def plug(monkeypatch: pytest.MonkeyPatch, *units: Unit) -> None:
    monkeypatch.setitem(sys.modules, "depthai", FakeDepthai(*units))  # type: ignore[arg-type]


def source(uri: str = "oak:") -> LiveCamera:
    return LiveCamera(OakDriver(uri), None, "factory", QUICK)


def image(camera: LiveCamera) -> Image:
    found: list[Image] = []
    until(lambda: isinstance(item := camera.read(), Image) and not found.append(item))
    return found[0]


def test_images_come_with_the_devices_stamps_in_the_hosts_time(unit: Unit) -> None:
    connection = OakDriver("oak:").connect()
    grab = connection.grab()
    assert grab is not None
    assert grab.captured_ns == unit.taken_us * 1000
    assert unit.reconnection_attempts == 0
    pixels = grab.decode()
    assert isinstance(pixels, np.ndarray)
    assert pixels.shape == (480, 640, 3)
    unit.delay_us = -50_000  # a clock that isn't in step yet: no image is from the future
    grab = connection.grab()
    assert grab is not None
    assert grab.captured_ns <= time.monotonic_ns()
    connection.close()
    assert (unit.boots, unit.stops, unit.closes) == (1, 1, 1)


def test_factory_intrinsics_are_used(unit: Unit) -> None:
    camera = open_source(SourceConfig(uri="oak:"))
    with camera:
        distortion = (1.5, -2.25, 0.001, -0.002, 0.5, 1.25, -2.0, 0.25)
        assert camera.camera == Camera(640, 480, 430.5, 431.5, 318.25, 241.75, distortion=distortion)
        assert "factory" in camera.camera_origin
        assert camera.name == "OAK 14442C10D13EABCE00"


def test_fisheye_and_undistorted_intrinsics(unit: Unit) -> None:
    unit.model, unit.distortion = "Fisheye", [0.1, -0.2, 0.3, -0.4]
    with source() as camera:
        assert (camera.camera.model, camera.camera.distortion) == ("fisheye", (0.1, -0.2, 0.3, -0.4))
    unit.model, unit.distortion = "Perspective", []
    with source("oak:?undistort=yes") as camera:
        assert camera.camera.is_ideal
    assert unit.requested[4] is True


def test_intrinsics_that_no_model_here_has_are_refused(unit: Unit) -> None:
    unit.distortion[10] = 0.01
    with pytest.raises(SourceError, match="undistort=yes"):
        source().open()
    unit.distortion, unit.model = [], "Cylindrical"
    with pytest.raises(SourceError, match="undistort=yes"):
        source().open()
    assert unit.boots == unit.closes


NONE = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
OUTSIDE = [[430.5, 0.0, 900.0], [0.0, 431.5, 241.75], [0.0, 0.0, 1.0]]


@pytest.mark.parametrize("matrix", [NONE, OUTSIDE])
def test_a_device_without_calibration_needs_a_file(matrix: list[list[float]], unit: Unit) -> None:
    unit.matrix = matrix
    with pytest.raises(ConfigError, match="--camera FILE"):
        source().open()
    own = Camera(320, 240, 200.0, 200.0, 160.0, 120.0)
    with LiveCamera(OakDriver("oak:", own), own, "a file", QUICK) as camera:
        assert image(camera).pixels.shape == (240, 320, 3)  # the size follows the file


def test_whoever_has_intrinsics_is_not_held_up_by_those_that_no_model_has(unit: Unit) -> None:
    unit.distortion[10] = 0.01
    own = Camera(320, 240, 200.0, 200.0, 160.0, 120.0)
    with LiveCamera(OakDriver("oak:", own), own, "a file", QUICK) as camera:
        assert image(camera).pixels.shape == (240, 320, 3)
    with open_source(SourceConfig(uri="oak:"), calibrated=False) as uncalibrated:  # `calibrate` and `mask`
        assert isinstance(uncalibrated, LiveCamera)
        assert image(uncalibrated).pixels.shape == (480, 640, 3)


def test_settings_are_made(unit: Unit) -> None:
    OakDriver("oak:?socket=B&width=320&height=200&rate=60&exposure_ms=8&iso=800&focus=120").connect()
    assert unit.controls == {"socket": "CAM_B", "exposure_us": 8000, "iso": 800, "focus": 120}
    assert unit.requested == ((320, 200), "NV12", "CROP", 60.0, False)


def test_what_nobody_set_is_left_to_the_camera_and_focus_may_be_at_its_end(unit: Unit) -> None:
    OakDriver("oak:").connect()
    assert unit.controls == {"socket": "CAM_A"}
    OakDriver("oak:?focus=0").connect()
    assert unit.controls == {"socket": "CAM_A", "focus": 0}


def test_a_moment_without_an_image_is_no_error(unit: Unit) -> None:
    connection = OakDriver("oak:").connect()
    unit.silent = True
    assert connection.grab() is None
    unit.silent = False
    assert connection.grab() is not None


def test_settings_that_are_not_kept_are_refused(unit: Unit, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(oak, "_FIRST_S", 0.1)
    unit.exposure_us = 33_000
    with pytest.raises(SourceError, match="exposes for 33 ms where 8 ms was asked for"):
        source("oak:?exposure_ms=8").open()
    unit.size = (640, 400)
    with pytest.raises(SourceError, match="640x400 where 640x480"):
        source().open()
    unit.silent = True
    with pytest.raises(SourceError, match="gives no image"):
        source().open()
    assert unit.boots == unit.closes == 3


@pytest.mark.parametrize("fault", ["unplugged", "link", "queue"])
def test_a_broken_link_is_opened_again(unit: Unit, fault: str) -> None:
    with source() as camera:
        before = image(camera)
        if fault == "unplugged":
            unit.present = False
        elif fault == "link":
            unit.link_error = "Couldn't read data from stream: 'x_0_0' (X_LINK_ERROR)"
        else:
            unit.closed_queue = True
        until(lambda: camera.health()["camera"].startswith("reconnecting"))
        until(lambda: unit.closes >= 1)
        unit.present, unit.link_error, unit.closed_queue = True, "", False
        until(lambda: camera.health()["camera"] == "streaming")
        after = image(camera)
    assert after.captured_monotonic_ns > before.captured_monotonic_ns
    assert unit.boots == unit.closes >= 2


def test_a_device_that_falls_silent_is_opened_again(unit: Unit) -> None:
    with source("oak:?timeout=0.2") as camera:
        image(camera)
        unit.silent = True
        until(lambda: camera.health()["camera"].startswith("reconnecting"))
        unit.silent = False
        until(lambda: camera.health()["camera"] == "streaming")


def test_it_stays_with_its_device(monkeypatch: pytest.MonkeyPatch) -> None:
    first, second = Unit("AAAA"), Unit("BBBB")
    plug(monkeypatch, first, second)
    with source() as camera:
        image(camera)
        first.present = False
        until(lambda: "no OAK AAAA is there (present: BBBB)" in camera.health()["camera"])
        assert second.boots == 0
    with source("oak:BBBB") as camera:
        image(camera)
    assert second.boots == 1


def test_a_device_by_its_address(unit: Unit) -> None:
    unit.name = "10.0.0.7"
    OakDriver("oak:10.0.0.7").connect()
    with pytest.raises(CameraLostError, match="Cannot find any device"):
        OakDriver("oak:10.0.0.8").connect()
    with pytest.raises(CameraLostError, match=r"no OAK CCCC is there \(present: 14442C10D13EABCE00\)"):
        OakDriver("oak:CCCC").connect()


def test_a_device_beyond_the_local_network_is_opened_again(unit: Unit) -> None:
    unit.name, unit.listed = "10.0.0.7", False
    driver = OakDriver("oak:10.0.0.7")
    for _ in range(2):
        driver.connect().close()
        assert driver.name == "OAK 14442C10D13EABCE00"


def test_images_that_were_lost_show_as_gaps_and_damaged_ones_are_unreadable(unit: Unit) -> None:
    connection = OakDriver("oak:").connect()
    connection.grab()
    unit.skip = 5
    grab = connection.grab()
    assert grab is not None
    assert grab.missed == 5
    with source() as camera:
        image(camera)
        unit.damaged = True
        until(lambda: isinstance(item := camera.read(), Unreadable) and "enough data" in item.reason)


@pytest.mark.parametrize(
    ("uri", "words"),
    [
        ("oak:?socket=Z", "A, B, C, D"),
        ("oak:?width=640", "go together"),
        ("oak:?rate=0", "between 1 and 240"),
        ("oak:X?speed=3", "unknown option"),
    ],
)
def test_wrong_addresses_are_one_line(uri: str, words: str) -> None:
    with pytest.raises(SourceError, match=words):
        OakDriver(uri)


def test_what_is_not_there_is_one_line(unit: Unit, monkeypatch: pytest.MonkeyPatch) -> None:
    unit.sockets = ["CAM_A"]
    with pytest.raises(SourceError, match="no camera B"):
        OakDriver("oak:?socket=B").connect()
    plug(monkeypatch)
    with pytest.raises(CameraLostError, match="no OAK device"):
        OakDriver("oak:").connect()
    monkeypatch.setattr(FakeDepthai, "__version__", "2.30.0")
    with pytest.raises(SourceError, match="depthai 3, not 2"):
        OakDriver("oak:").connect()
    monkeypatch.setitem(sys.modules, "depthai", None)
    with pytest.raises(SourceError, match=r"prism-edge\[oak\]"):
        OakDriver("oak:").connect()
    with pytest.raises(ConfigError, match="asks for 64x48"):
        OakDriver("oak:?width=64&height=48", Camera(128, 96, 100.0, 100.0, 63.5, 47.5))


def test_nothing_else_loads_the_heavy_libraries() -> None:
    code = (
        "import sys, prism_edge.workers.source, prism_edge.sources.open;"
        "from prism_edge.config import SourceConfig;"
        "prism_edge.sources.open.open_source(SourceConfig(uri='oak:'));"
        "print([name for name in ('depthai', 'av') if name in sys.modules])"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "[]"


def test_against_the_real_library() -> None:
    """Where depthai is installed: the calls that need no device are there and mean what we take them for."""
    dai = pytest.importorskip("depthai", reason="depthai is not installed: pip install 'prism-edge[oak]'")
    matrix, distortion = [[800, 0, 640], [0, 810, 360], [0, 0, 1]], [0.5, -0.25] + [0.0] * 12
    transformation = dai.ImgTransformation(1280, 720, matrix, dai.CameraModel.Perspective, distortion)
    transformation.addScale(0.5, 0.5)
    found = oak.intrinsics_of(dai, transformation)
    assert found == Camera(640, 360, 400.0, 405.0, 320.0, 180.0, distortion=(0.5, -0.25, 0, 0, 0, 0, 0, 0))
    assert oak.intrinsics_of(dai, dai.ImgTransformation(640, 480)) is None
    assert abs(dai.Clock.now() / timedelta(seconds=1) - time.monotonic()) < 1.0
    frame = dai.ImgFrame()
    frame.setCvFrame(np.full((48, 64, 3), 90, np.uint8), dai.ImgFrame.Type.NV12)
    frame.setTimestamp(timedelta(microseconds=123_456_789))
    # A frame that no camera made has any exposure (depthai 3.0 leaves it as memory was).
    middle = frame.getTimestamp(dai.CameraExposureOffset.MIDDLE) + frame.getExposureTime() / 2
    assert abs(middle - timedelta(microseconds=123_456_789)) <= timedelta(microseconds=1)
    pixels = oak._pixels(frame)
    assert pixels.shape == (48, 64, 3)
    assert abs(int(pixels[20, 20, 0]) - 90) < 4
    queue = dai.MessageQueue("test", 1, False)
    assert queue.get(timedelta(milliseconds=10)) is None
    queue.close()
    with pytest.raises(dai.MessageQueue.QueueException):
        queue.get(timedelta(milliseconds=10))
    for name, methods in {
        "Device": ("getAllAvailableDevices", "setMaxReconnectionAttempts", "getConnectedCameras", "close"),
        "Pipeline": ("create", "start", "stop"),
        "ImgFrame": ("getSequenceNum", "getExposureTime", "getTransformation", "getWidth", "getHeight"),
        "CameraControl": ("setManualExposure", "setManualFocus"),
    }.items():
        assert all(hasattr(getattr(dai, name), method) for method in methods)
    assert hasattr(dai.node.Camera, "requestOutput")
    assert dai.ImgResizeMode.CROP is not None
    assert dai.CameraBoardSocket.CAM_D is not None
