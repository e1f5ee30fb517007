"""A camera behind the system calls: a driver in miniature, with the faults that real ones are known for."""

from __future__ import annotations

import errno
import os
import time
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from prism_edge.sources.live import v4l2_abi as abi

SOE = 0x1_0000  # V4L2_BUF_FLAG_TSTAMP_SRC_SOE


@dataclass
class FakeCamera:
    """Stands in for :class:`Kernel`; every attribute may be changed while it runs."""

    path: str = "/dev/v4l/by-id/usb-Acme-video-index0"
    card: str = "Acme Cam"
    # format -> size -> highest rate
    modes: dict[str, dict[tuple[int, int], float]] = field(
        default_factory=lambda: {
            "YUYV": {(64, 48): 30.0, (128, 96): 5.0},
            "MJPG": {(64, 48): 30.0, (128, 96): 30.0},
        }
    )
    # control -> [least, greatest, value]
    controls: dict[int, list[int]] = field(
        default_factory=lambda: {
            abi.CID_EXPOSURE_AUTO: [0, 3, 3],
            abi.CID_EXPOSURE_ABSOLUTE: [3, 2047, 250],
            abi.CID_EXPOSURE_AUTO_PRIORITY: [0, 1, 1],
            abi.CID_GAIN: [0, 100, 50],
        }
    )
    stubborn: set[int] = field(default_factory=set)  # controls that are accepted and stay as they are
    stalling: set[int] = field(default_factory=set)  # controls whose range the firmware doesn't tell
    resets_on_stream: dict[int, int] = field(default_factory=dict)
    capabilities: int = abi.CAP_VIDEO_CAPTURE | abi.CAP_STREAMING
    plugged: bool = True
    silent: bool = False  # no images, no errors: a hung camera
    allowed: bool = True
    busy: bool = False
    stream_error: int = 0
    stamp_flags: int = abi.BUF_FLAG_TIMESTAMP_MONOTONIC | SOE
    stamp_shift_ns: int = 0
    frame: bytes = b""  # what a buffer holds; empty: grey noise in the format of now
    flags: int = 0
    fields: int = abi.FIELD_NONE  # the order of an image's fields, whatever is asked for
    skip: int = 0  # images that the kernel lost before the next
    opened: int = 0
    closed: int = 0
    mapped: int = 0
    exposed_ns: int = 0  # when the newest image was taken

    _descriptors: set[int] = field(default_factory=set)
    _next: int = 100
    _pix: tuple[int, int, str] = (128, 96, "YUYV")
    _rate: float = 30.0
    _queue: list[int] = field(default_factory=list)
    _maps: dict[int, bytearray] = field(default_factory=dict)
    _streaming: bool = False
    _sequence: int = 0

    def open(self, path: str) -> int:
        if path != self.path or not self.plugged:
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT))
        if not self.allowed:
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
        self.opened += 1
        self._next += 1
        self._descriptors = {self._next}  # those of before it was unplugged are dead
        self._streaming, self._queue, self._maps = False, [], {}
        return self._next

    def close(self, fd: int) -> None:
        self.closed += 1
        self._descriptors.discard(fd)

    def unplug(self) -> None:
        self.plugged = False
        self._descriptors.clear()

    def wait(self, fd: int, timeout_s: float) -> bool:
        if fd not in self._descriptors:
            return True  # POLLERR
        if self.silent or not self._streaming or not self._queue:
            time.sleep(min(timeout_s, 0.005))
            return False
        time.sleep(0.001)
        return True

    def map(self, fd: int, length: int, offset: int) -> Any:
        self.mapped += 1
        outer = self

        class Map(bytearray):
            def close(self) -> None:
                outer.mapped -= 1

        self._maps[offset // 4096] = Map(length)
        return self._maps[offset // 4096]

    def ioctl(self, fd: int, code: int, argument: Any) -> None:
        if fd not in self._descriptors:
            self._fail(errno.ENODEV)
        calls = {
            abi.VIDIOC_QUERYCAP: self._querycap,
            abi.VIDIOC_ENUM_FMT: self._enum_fmt,
            abi.VIDIOC_S_FMT: self._s_fmt,
            abi.VIDIOC_G_FMT: self._g_fmt,
            abi.VIDIOC_S_PARM: self._s_parm,
            abi.VIDIOC_G_PARM: self._g_parm,
            abi.VIDIOC_QUERYCTRL: self._queryctrl,
            abi.VIDIOC_S_CTRL: self._s_ctrl,
            abi.VIDIOC_G_CTRL: self._g_ctrl,
            abi.VIDIOC_REQBUFS: self._reqbufs,
            abi.VIDIOC_QUERYBUF: self._querybuf,
            abi.VIDIOC_QBUF: lambda buffer: self._queue.append(buffer.index),
            abi.VIDIOC_DQBUF: self._dqbuf,
            abi.VIDIOC_STREAMON: self._streamon,
            abi.VIDIOC_STREAMOFF: lambda _: None,
        }
        calls[code](argument)

    @staticmethod
    def _fail(number: int) -> None:
        raise OSError(number, os.strerror(number))

    def _querycap(self, capability: abi.Capability) -> None:
        if not self.capabilities:
            self._fail(errno.ENOTTY)
        capability.card[: len(self.card)] = self.card.encode()
        capability.capabilities = 0xFFFF | abi.CAP_DEVICE_CAPS | abi.CAP_STREAMING
        capability.device_caps = self.capabilities

    def _enum_fmt(self, entry: abi.FmtDesc) -> None:
        if entry.index >= len(self.modes):
            self._fail(errno.EINVAL)
        entry.pixelformat = abi.fourcc(list(self.modes)[entry.index])

    def _s_fmt(self, asked: abi.Format) -> None:
        if self.busy:
            self._fail(errno.EBUSY)
        name = abi.fourcc_name(asked.fmt.pix.pixelformat)
        sizes = self.modes.get(name) or next(iter(self.modes.values()))
        # As drivers do: the nearest there is, and no error.
        width, height = min(sizes, key=lambda size: abs(size[0] - asked.fmt.pix.width))
        self._pix = (width, height, name if name in self.modes else next(iter(self.modes)))
        self._rate = sizes[width, height]

    def _g_fmt(self, found: abi.Format) -> None:
        width, height, name = self._pix
        stride = 0 if name == "MJPG" else width * 2
        size, code = 2 * width * height, abi.fourcc(name)
        found.fmt.pix = abi.PixFormat(width, height, code, self.fields, stride, size)

    def _s_parm(self, asked: abi.StreamParm) -> None:
        wanted = asked.timeperframe.denominator / asked.timeperframe.numerator
        self._rate = min(wanted, self.modes[self._pix[2]][self._pix[:2]])

    def _g_parm(self, found: abi.StreamParm) -> None:
        found.capability = abi.CAP_TIMEPERFRAME
        found.timeperframe = abi.Fract(1000, round(1000 * self._rate))

    def _queryctrl(self, query: abi.QueryCtrl) -> None:
        if query.id in self.stalling:
            self._fail(errno.EIO)
        if query.id not in self.controls:
            self._fail(errno.EINVAL)
        query.minimum, query.maximum, _ = self.controls[query.id]

    def _s_ctrl(self, control: abi.Control) -> None:
        low, high, _ = self.controls[control.id]
        if not low <= control.value <= high:
            self._fail(errno.ERANGE)
        if control.id not in self.stubborn:
            self.controls[control.id][2] = control.value

    def _g_ctrl(self, control: abi.Control) -> None:
        control.value = self.controls[control.id][2]

    def _reqbufs(self, request: abi.RequestBuffers) -> None:
        request.count = min(request.count, 3)

    def _querybuf(self, buffer: abi.Buffer) -> None:
        buffer.length = 2 * self._pix[0] * self._pix[1]
        buffer.m.offset = 4096 * buffer.index

    def _streamon(self, _: Any) -> None:
        if self.stream_error:
            self._fail(self.stream_error)
        for control, value in self.resets_on_stream.items():
            self.controls[control][2] = value
        self._streaming = True

    def _dqbuf(self, buffer: abi.Buffer) -> None:
        index = self._queue.pop(0)
        width, height, _ = self._pix
        data = self.frame or np.random.default_rng(self._sequence).bytes(2 * width * height)
        self._maps[index][: len(data)] = data
        self._sequence += 1 + self.skip
        self.skip = 0
        # Taken 0.7 ms ago; a stamp has microseconds.
        self.exposed_ns = (time.monotonic_ns() - 700_000) // 1000 * 1000
        seconds, rest = divmod(self.exposed_ns + self.stamp_shift_ns, 1_000_000_000)
        buffer.index, buffer.bytesused, buffer.sequence = index, len(data), self._sequence
        buffer.flags = self.stamp_flags | self.flags
        buffer.timestamp = abi.TimeVal(seconds, rest // 1000)
