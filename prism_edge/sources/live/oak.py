"""OAK cameras through depthai 3, which is loaded here alone, and only when one connects: it takes 108 MB."""

from __future__ import annotations

import contextlib
import importlib
import ipaddress
import logging
import time
from dataclasses import dataclass, replace
from datetime import timedelta
from typing import Any

from prism_edge.config import limits, one_of
from prism_edge.errors import ConfigError, SourceError, first_line
from prism_edge.geometry.cameras import FISHEYE, PINHOLE, Camera
from prism_edge.sources.address import parse_options
from prism_edge.sources.live.driver import CameraLostError, Grab, size_for

log = logging.getLogger("prism_edge.sources")

SCHEME = "oak:"

_BOOT_S = 15.0  # a device takes about 5 s, and depthai 10 to find that there is none at an address
_FIRST_S = 15.0  # until an image is as asked for: the first ones tell another exposure
_WAIT = timedelta(milliseconds=200)
_MICROSECOND = timedelta(microseconds=1)
_EXPOSURE_TOLERANCE = 0.1
_INSTEAD = "set undistort=yes, or give a camera file (--camera FILE)"
_RADIAL = 8  # coefficients of a rational model; what follows is a thin prism's and a tilted sensor's


@dataclass(frozen=True)
class Options:
    """What may stand behind ? in an OAK's address."""

    socket: str = one_of("A", "A", "B", "C", "D", help="which of its cameras: A is the colour one")
    width: int = limits(0, 0, 8192, "pixels of a row; 0: the camera file's, or 640")
    height: int = limits(0, 0, 8192, "rows; 0: the camera file's, or 480")
    rate: float = limits(30.0, 1.0, 240.0, "images a second")
    undistort: str = one_of("no", "no", "yes", help="have the device take the distortion out")
    exposure_ms: float = limits(0.0, 0.0, 1000.0, "exposure; 0: automatic")
    iso: int = limits(400, 100, 1600, "sensitivity that goes with a fixed exposure")
    focus: int = limits(-1, -1, 255, "fixed position of the lens; -1: as the device does it")
    timeout: float = limits(2.0, 0.2, 60.0, "seconds without an image after which it is opened again")


def is_oak(uri: str) -> bool:
    """Whether an address is one of ours."""
    return uri.startswith(SCHEME)


class OakDriver:
    """``oak:``, or ``oak:ID`` with a device's id or IP address, and options behind a question mark."""

    def __init__(self, uri: str, camera: Camera | None = None) -> None:
        """Raises SourceError where the address is wrong, ConfigError where it contradicts ``camera``."""
        self._id, _, query = uri.removeprefix(SCHEME).partition("?")
        options = Options(**parse_options(f"{SCHEME}{self._id}", query, Options))
        if bool(options.width) != bool(options.height):
            raise SourceError(f"{uri}: width and height go together")
        width, height = size_for(options.width, options.height, camera, uri)
        self.options = options = replace(options, width=width or 640, height=height or 480)
        self.name = f"OAK {self._id}".strip()
        self.period_ns = round(1e9 / options.rate)
        self.dead_s = options.timeout
        self.connect_s = _BOOT_S + _FIRST_S

    def connect(self) -> OakConnection:
        """Boots the device and waits for its first image.

        Raises CameraLostError where it isn't there or doesn't start, SourceError where it has another
        size or exposure than asked for, or no such camera.
        """
        dai = _depthai()
        connection = None
        try:
            device = self._device(dai)
            try:
                device.setMaxReconnectionAttempts(0)  # depthai's own would block in here
                connection = OakConnection(dai, device, self.options)
                connection.start()
            except BaseException:
                if connection is not None:
                    connection.close()
                else:
                    device.close()
                raise
        except RuntimeError as error:
            raise CameraLostError(first_line(error)) from None
        found = device.getDeviceId()
        if not _is_ip(self._id):  # what was found by its address may be found by nothing else
            self._id = found  # from now on this one, whatever else is plugged in
        self.name = f"OAK {found or self._id}"
        return connection

    def _device(self, dai: Any) -> Any:
        """The one of the address; looked for first, as depthai takes 10 s to find that it isn't there."""
        present = dai.Device.getAllAvailableDevices()
        if not self._id:
            if not present:
                raise CameraLostError("no OAK device is there, or none may be opened (udev rule)")
            return dai.Device(present[0])
        for info in present:
            if self._id in (info.deviceId, info.name):
                return dai.Device(info)
        if _is_ip(self._id):  # beyond the local network a device isn't seen, but may answer
            return dai.Device(dai.DeviceInfo(self._id))
        others = ", ".join(info.deviceId for info in present) or "none"
        raise CameraLostError(f"no OAK {self._id} is there (present: {others})")


class OakConnection:
    """A device with a running pipeline of one camera."""

    def __init__(self, dai: Any, device: Any, options: Options) -> None:
        self._dai, self._device, self._options = dai, device, options
        self._transformation: Any = None  # of its first image
        socket = getattr(dai.CameraBoardSocket, f"CAM_{options.socket}")
        if socket not in device.getConnectedCameras():
            raise SourceError(f"the OAK has no camera {options.socket}")
        self._pipeline = dai.Pipeline(device)
        camera = self._pipeline.create(dai.node.Camera).build(socket)
        if options.exposure_ms:
            camera.initialControl.setManualExposure(round(options.exposure_ms * 1000), options.iso)
        if options.focus >= 0:
            camera.initialControl.setManualFocus(options.focus)
        output = camera.requestOutput(
            (options.width, options.height),
            dai.ImgFrame.Type.NV12,
            dai.ImgResizeMode.CROP,
            options.rate,
            options.undistort == "yes",
        )
        # One image, replaced by a newer one: nothing queues up.
        self._queue = output.createOutputQueue(maxSize=1, blocking=False)
        self._sequence = -1

    def start(self) -> None:
        """Runs the pipeline until an image is as asked for; its intrinsics may then be asked for."""
        self._pipeline.start()
        deadline = time.monotonic() + _FIRST_S
        problem = "gives no image"
        while time.monotonic() < deadline:
            frame = self._next()
            if frame is None:
                continue
            problem = self._difference(frame)
            if not problem:
                self._transformation = frame.getTransformation()
                return
        if problem == "gives no image":
            raise CameraLostError(f"the OAK {problem}")
        raise SourceError(f"the OAK {problem}")

    @property
    def intrinsics(self) -> Camera | None:
        """The factory's; raises SourceError where no camera model here has them."""
        return intrinsics_of(self._dai, self._transformation)

    def grab(self) -> Grab | None:
        """The next image; raises CameraLostError where the link to the device breaks (X_LINK_ERROR)."""
        frame = self._next()
        if frame is None:
            return None
        # The middle of the exposure; depthai has put the device's clock into the host's, steadily synced.
        captured = frame.getTimestamp(self._dai.CameraExposureOffset.MIDDLE)
        captured_ns = min(captured // _MICROSECOND * 1000, time.monotonic_ns())
        missed = frame.getSequenceNum() - self._sequence - 1 if self._sequence >= 0 else 0
        self._sequence = frame.getSequenceNum()
        return Grab(captured_ns, lambda: _pixels(frame), missed if 0 < missed < 1000 else 0)

    def close(self) -> None:
        for part in (self._pipeline.stop, self._device.close):
            with contextlib.suppress(Exception):  # the device may be gone
                part()

    def _next(self) -> Any:
        try:
            return self._queue.get(_WAIT)
        except (RuntimeError, self._dai.MessageQueue.QueueException) as error:
            raise CameraLostError(first_line(error)) from None

    def _difference(self, frame: Any) -> str:
        options = self._options
        width, height = frame.getWidth(), frame.getHeight()
        if (width, height) != (options.width, options.height):
            return f"gives {width}x{height} where {options.width}x{options.height} was asked for"
        exposure_ms = frame.getExposureTime() / timedelta(milliseconds=1)
        if options.exposure_ms and abs(exposure_ms / options.exposure_ms - 1) > _EXPOSURE_TOLERANCE:
            return f"exposes for {exposure_ms:.3g} ms where {options.exposure_ms:g} ms was asked for"
        return ""


def intrinsics_of(dai: Any, transformation: Any) -> Camera | None:
    """The factory's intrinsics, carried over to the image as it was cropped and scaled on the device.

    None where the device was never calibrated, or as no camera can be. Raises SourceError for a distortion
    that no camera model here has.
    """
    (fx, skew, cx), (_, fy, cy), _ = transformation.getIntrinsicMatrix()
    if fx <= 1.0 or fy <= 1.0:  # the unit matrix stands for none
        return None
    width, height = transformation.getSize()
    distortion = [float(value) for value in transformation.getDistortionCoefficients()]
    model = transformation.getDistortionModel()
    if abs(skew) > 1e-3 * fx or model not in (dai.CameraModel.Perspective, dai.CameraModel.Fisheye):
        raise SourceError(f"the OAK's images are no plain camera's: {_INSTEAD}")
    if model == dai.CameraModel.Fisheye:
        kept, rest, name = distortion[:4], distortion[4:], FISHEYE
    else:
        kept, rest, name = distortion[:_RADIAL], distortion[_RADIAL:], PINHOLE
        kept = (kept + [0.0] * _RADIAL)[:_RADIAL] if any(kept) else []
    if any(rest):
        raise SourceError(f"the OAK's lens needs more than 8 coefficients: {_INSTEAD}")
    try:
        return Camera(width, height, fx, fy, cx, cy, name, tuple(kept))
    except ConfigError as error:
        log.warning("the OAK's own intrinsics are passed over: %s", error)
        return None


def _pixels(frame: Any) -> Any:
    try:
        return frame.getCvFrame()
    except RuntimeError as error:  # fewer bytes than the image takes
        return f"is damaged ({first_line(error)})"


def _is_ip(text: str) -> bool:
    try:
        ipaddress.ip_address(text)
    except ValueError:
        return False
    return True


def _depthai() -> Any:
    try:
        dai = importlib.import_module("depthai")
    except ImportError:
        raise SourceError("OAK cameras need depthai 3: pip install 'prism-edge[oak]'") from None
    if int(str(dai.__version__).split(".", 1)[0]) < 3:
        raise SourceError(f"OAK cameras need depthai 3, not {dai.__version__}: pip install 'prism-edge[oak]'")
    return dai
