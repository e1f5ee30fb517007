"""USB and other cameras of Linux, through the kernel's own interface, with the kernel's stamps."""

from __future__ import annotations

import contextlib
import errno
import logging
import time
from dataclasses import replace
from typing import Any

from prism_edge.errors import SourceError
from prism_edge.geometry.cameras import Camera
from prism_edge.sources.address import parse_options
from prism_edge.sources.base import DEFAULT_RATE_HZ
from prism_edge.sources.live import v4l2_abi as abi
from prism_edge.sources.live.driver import CameraLostError, Grab, size_for
from prism_edge.sources.live.v4l2_device import Device, Mode
from prism_edge.sources.live.v4l2_kernel import Kernel
from prism_edge.sources.live.v4l2_pixels import to_image
from prism_edge.sources.live.v4l2_settings import Options, check, choose_mode, set_controls

log = logging.getLogger("prism_edge.sources")

SCHEME = "v4l2:"

_BUFFERS = 4  # one is being filled, one waits, one is read; one more for a late thread
_WAIT_S = 0.2
_CONNECT_S = 15.0  # the kernel gives a USB camera 5 s for an answer
_OLDEST_NS = 2_000_000_000  # a stamp older than this is of another clock


def is_v4l2(uri: str) -> bool:
    """Whether an address is one of ours."""
    return uri.startswith(SCHEME)


class V4l2Driver:
    """``v4l2:PATH?width=..&rate=..``; PATH may be a link in /dev/v4l/by-id, which replugging keeps."""

    def __init__(self, uri: str, camera: Camera | None = None, kernel: Kernel | None = None) -> None:
        """Raises SourceError where the address is wrong, ConfigError where it contradicts ``camera``."""
        self.path, _, query = uri.removeprefix(SCHEME).partition("?")
        if not self.path.startswith("/"):
            raise SourceError(f"{uri}: name the device by its path, such as v4l2:/dev/video0")
        options = Options(**parse_options(f"{SCHEME}{self.path}", query, Options))
        if bool(options.width) != bool(options.height):
            raise SourceError(f"{SCHEME}{self.path}: width and height go together")
        width, height = size_for(options.width, options.height, camera, uri)
        self.options = options = replace(options, width=width, height=height)
        self.name = f"camera {self.path}"
        self.period_ns = round(1e9 / (options.rate or DEFAULT_RATE_HZ))
        self.dead_s = options.timeout
        self.connect_s = _CONNECT_S
        self._kernel = kernel or Kernel()
        self._card = ""

    def connect(self) -> V4l2Connection:
        """Opens, sets, reads back, starts; see the errors of :class:`Device` and of the settings."""
        device = Device(self.path, self._kernel)
        try:
            if self._card and device.card != self._card:
                raise CameraLostError(f"another camera, {device.card}, is at {self.path} now")
            device.claim()
            set_controls(device, self.options)  # before the mode: automatic exposure may hold the rate down
            mode = choose_mode(device, self.options)
            if mode.stacked:
                raise SourceError(
                    f"{device.card} gives two half pictures, one above the other (its fields in sequence): "
                    "ask its driver for one field, or a progressive mode"
                )
            connection = V4l2Connection(device, self._kernel, mode, self.options)
        except BaseException:
            device.close()
            raise
        try:
            check(device, self.options, mode)  # now that images flow: some settings fall back then
        except BaseException:
            connection.close()
            raise
        self._card = device.card
        # Replugged, it is at its own default; the intrinsics, and the mask, are for the size of now.
        self.options = replace(self.options, width=mode.width, height=mode.height)
        self.name = f"camera {self.path} ({device.card}, {mode.pixels} {mode.width}x{mode.height})"
        if mode.rate_hz:
            self.period_ns = round(1e9 / mode.rate_hz)
        if mode.interlaced:
            log.warning("%s is interlaced: rows of two times are in an image, and tear what moves", self.name)
        return connection


class V4l2Connection:
    """Buffers shared with the driver, and the images in them."""

    intrinsics: Camera | None = None

    def __init__(self, device: Device, kernel: Kernel, mode: Mode, options: Options) -> None:
        self._device, self._kernel, self._mode = device, kernel, mode
        self._delay_ns = round(options.delay_ms * 1e6)
        self._buffers: list[Any] = []
        self._sequence = -1
        request = abi.RequestBuffers(count=_BUFFERS, type=abi.BUF_TYPE_VIDEO_CAPTURE, memory=abi.MEMORY_MMAP)
        device.call(abi.VIDIOC_REQBUFS, request, "asking for buffers")
        if request.count < 2:
            raise CameraLostError(f"the driver has {request.count} buffers, two are needed")
        for index in range(request.count):
            buffer = device.call(abi.VIDIOC_QUERYBUF, self._buffer(index), "asking for a buffer")
            try:
                self._buffers.append(kernel.map(device.fd, buffer.length, buffer.m.offset))
            except OSError as error:
                raise CameraLostError(f"mapping a buffer fails ({error.strerror})") from None
            device.call(abi.VIDIOC_QBUF, self._buffer(index), "queueing a buffer")
        device.stream(True)

    def grab(self) -> Grab | None:
        """The next image the kernel has; raises CameraLostError where the device is gone."""
        if not self._kernel.wait(self._device.fd, _WAIT_S):
            return None
        buffer = self._buffer(0)
        try:
            self._kernel.ioctl(self._device.fd, abi.VIDIOC_DQBUF, buffer)
        except OSError as error:
            if error.errno in (errno.EAGAIN, errno.EINTR):
                return None
            gone = error.errno == errno.ENODEV
            raise CameraLostError("unplugged" if gone else f"reading fails ({error.strerror})") from None
        arrival_ns = time.monotonic_ns()
        # Copied, as the driver gets its buffer back at once.
        data = bytes(self._buffers[buffer.index][: buffer.bytesused])
        self._device.call(abi.VIDIOC_QBUF, self._buffer(buffer.index), "giving a buffer back")
        missed = buffer.sequence - self._sequence - 1 if self._sequence >= 0 else 0
        self._sequence = buffer.sequence
        damaged = bool(buffer.flags & abi.BUF_FLAG_ERROR)
        captured_ns = self._captured_ns(buffer, arrival_ns) - self._delay_ns
        mode = self._mode

        def decode() -> Any:
            if damaged:
                return "was damaged on its way over the bus"
            return to_image(data, mode.pixels, mode.width, mode.height, mode.stride)

        return Grab(captured_ns, decode, missed if 0 < missed < 1000 else 0)

    def close(self) -> None:
        with contextlib.suppress(CameraLostError, SourceError):  # it may be gone already
            self._device.stream(False)
        for buffer in self._buffers:
            with contextlib.suppress(BufferError, OSError):
                buffer.close()
        self._buffers = []
        with contextlib.suppress(OSError):
            self._device.close()

    def _captured_ns(self, buffer: abi.Buffer, arrival_ns: int) -> int:
        stamp = buffer.timestamp
        captured_ns = stamp.tv_sec * 1_000_000_000 + stamp.tv_usec * 1000
        monotonic = buffer.flags & abi.BUF_FLAG_TIMESTAMP_MASK == abi.BUF_FLAG_TIMESTAMP_MONOTONIC
        believable = arrival_ns - _OLDEST_NS <= captured_ns <= arrival_ns
        return captured_ns if monotonic and believable else arrival_ns

    @staticmethod
    def _buffer(index: int) -> abi.Buffer:
        return abi.Buffer(index=index, type=abi.BUF_TYPE_VIDEO_CAPTURE, memory=abi.MEMORY_MMAP)
