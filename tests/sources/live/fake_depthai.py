"""depthai 3 at its border, without a device: what our source calls of it, and how it fails."""

# ruff: noqa: N802 - the names are depthai's

from __future__ import annotations

import time
from datetime import timedelta
from types import SimpleNamespace
from typing import Any

import numpy as np

X_LINK = (
    "Communication exception - possible device error/misconfiguration. Original message "
    "'Couldn't read data from stream: 'x_0_0' (X_LINK_ERROR)'"
)


class QueueException(Exception):  # noqa: N818 - depthai's own name
    """As depthai's, which is no RuntimeError."""


class Unit:
    """One device; every attribute may be changed while it runs."""

    def __init__(self, device_id: str = "14442C10D13EABCE00") -> None:
        self.device_id, self.name = device_id, "1.2"
        self.sockets = ["CAM_A", "CAM_B", "CAM_C"]
        self.matrix = [[430.5, 0.0, 318.25], [0.0, 431.5, 241.75], [0.0, 0.0, 1.0]]
        self.distortion = [1.5, -2.25, 0.001, -0.002, 0.5, 1.25, -2.0, 0.25] + [0.0] * 6
        self.model = "Perspective"
        self.present = self.listed = True  # a device beyond the local network is there, and not seen
        self.link_error = ""  # raised by whatever is asked of it
        self.silent = self.closed_queue = self.damaged = False
        self.size: tuple[int, int] | None = None  # other than asked for
        self.exposure_us = 0  # other than asked for
        self.skip = 0
        self.delay_us = 4000
        self.sequence = 0
        self.boots = self.closes = self.stops = 0
        self.reconnection_attempts = 10
        self.controls: dict[str, Any] = {}
        self.requested: tuple[Any, ...] = ()
        self.taken_us = 0


class FakeDepthai:
    """The module."""

    __version__ = "3.12.0"

    def __init__(self, *units: Unit) -> None:
        self.units = list(units)
        self.CameraBoardSocket = SimpleNamespace(**{f"CAM_{k}": f"CAM_{k}" for k in "ABCD"})
        models = ("Perspective", "Fisheye", "Cylindrical")
        self.CameraModel = SimpleNamespace(**{name: name for name in models})
        self.CameraExposureOffset = SimpleNamespace(MIDDLE="MIDDLE")
        self.ImgFrame = SimpleNamespace(Type=SimpleNamespace(NV12="NV12"))
        self.ImgResizeMode = SimpleNamespace(CROP="CROP")
        self.MessageQueue = SimpleNamespace(QueueException=QueueException)
        self.node = SimpleNamespace(Camera="Camera")
        module = self

        class Device:
            def __init__(self, info: Any) -> None:
                found = [u for u in module.units if u.present and info.deviceId in (u.device_id, u.name)]
                if not found:
                    raise RuntimeError("Cannot find any device with given deviceInfo")
                self.unit = found[0]
                _raise(self.unit)
                self.unit.boots += 1

            @staticmethod
            def getAllAvailableDevices() -> list[Any]:
                there = [unit for unit in module.units if unit.present and unit.listed]
                return [SimpleNamespace(deviceId=unit.device_id, name=unit.name) for unit in there]

            def setMaxReconnectionAttempts(self, attempts: int) -> None:
                self.unit.reconnection_attempts = attempts

            def getConnectedCameras(self) -> list[str]:
                return self.unit.sockets

            def getDeviceId(self) -> str:
                return self.unit.device_id

            def close(self) -> None:
                self.unit.closes += 1
                _raise(self.unit)

        self.Device = Device
        self.DeviceInfo = lambda text: SimpleNamespace(deviceId=text, name=text)
        self.Pipeline = Pipeline


class Pipeline:
    def __init__(self, device: Any) -> None:
        self._unit: Unit = device.unit

    def create(self, node: str) -> Pipeline:
        assert node == "Camera"
        return self

    def build(self, socket: str) -> Pipeline:
        self._unit.controls["socket"] = socket
        return self

    @property
    def initialControl(self) -> Any:
        controls = self._unit.controls
        return SimpleNamespace(
            setManualExposure=lambda us, iso: controls.update(exposure_us=us, iso=iso),
            setManualFocus=lambda position: controls.update(focus=position),
        )

    def requestOutput(
        self, size: Any, type: Any, resizeMode: Any, fps: float, enableUndistortion: bool
    ) -> Any:
        self._unit.requested = (size, type, resizeMode, fps, enableUndistortion)
        return SimpleNamespace(createOutputQueue=lambda maxSize, blocking: Queue(self._unit))

    def start(self) -> None:
        _raise(self._unit)

    def stop(self) -> None:
        self._unit.stops += 1
        _raise(self._unit)


class Queue:
    def __init__(self, unit: Unit) -> None:
        self._unit = unit

    def get(self, timeout: timedelta) -> Frame | None:
        unit = self._unit
        _raise(unit)
        if unit.closed_queue:
            raise QueueException("MessageQueue was closed")
        time.sleep(0.002)
        if unit.silent:
            return None
        unit.sequence += 1 + unit.skip
        unit.skip = 0
        unit.taken_us = time.monotonic_ns() // 1000 - unit.delay_us
        return Frame(unit)


class Frame:
    def __init__(self, unit: Unit) -> None:
        self._unit, self._sequence, self._taken_us = unit, unit.sequence, unit.taken_us
        self._size = unit.size or unit.requested[0]

    def getWidth(self) -> int:
        return self._size[0]

    def getHeight(self) -> int:
        return self._size[1]

    def getSequenceNum(self) -> int:
        return self._sequence

    def getTimestamp(self, offset: str) -> timedelta:
        assert offset == "MIDDLE"
        return timedelta(microseconds=self._taken_us)

    def getExposureTime(self) -> timedelta:
        return timedelta(microseconds=self._unit.exposure_us or self._unit.controls.get("exposure_us", 5000))

    def getCvFrame(self) -> Any:
        if self._unit.damaged:
            raise RuntimeError("ImgFrame doesn't have enough data to encode specified frame")
        return np.random.default_rng(self._sequence).integers(0, 255, (*self._size[::-1], 3), dtype=np.uint8)

    def getTransformation(self) -> Any:
        unit = self._unit
        return SimpleNamespace(
            getIntrinsicMatrix=lambda: unit.matrix,
            getDistortionCoefficients=lambda: unit.distortion,
            getDistortionModel=lambda: unit.model,
            getSize=lambda: self._size,
        )


def _raise(unit: Unit) -> None:
    if not unit.present:
        raise RuntimeError(X_LINK)
    if unit.link_error:
        raise RuntimeError(unit.link_error)
