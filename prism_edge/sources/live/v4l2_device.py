"""One opened Video4Linux device: what it is, what it can be set to, and what it was set to."""

from __future__ import annotations

import ctypes
import errno
from dataclasses import dataclass
from typing import Any

from prism_edge.errors import SourceError
from prism_edge.sources.live import v4l2_abi as abi
from prism_edge.sources.live.driver import CameraLostError
from prism_edge.sources.live.v4l2_kernel import Kernel

# There is no such control, or no such entry in a list.
_UNKNOWN = (errno.EINVAL, errno.ENOTTY)


@dataclass(frozen=True)
class Mode:
    """What a camera says it is set to."""

    width: int
    height: int
    pixels: str  # YUYV
    stride: int  # bytes a row, 0 where compressed
    rate_hz: float  # 0: it doesn't say
    interlaced: bool = False
    stacked: bool = False  # one field above the other: two small pictures


class Device:
    """Wraps a descriptor; raises CameraLostError where the device goes away, SourceError where it refuses."""

    def __init__(self, path: str, kernel: Kernel) -> None:
        self._path, self._kernel = path, kernel
        try:
            self.fd = kernel.open(path)
        except PermissionError:
            raise SourceError(
                f"no permission to open {path}: add the user to the group video "
                "(sudo usermod -aG video $USER)"
            ) from None
        except OSError as error:  # some drivers let one program alone open it
            raise self._lost(error, f"{path} is not there") from None
        try:
            self.card = self._identify()
        except BaseException:
            self.close()
            raise

    def call(self, code: int, argument: Any, what: str) -> Any:
        """An ioctl; ``what`` it is for names it in the error. Returns the argument."""
        try:
            self._kernel.ioctl(self.fd, code, argument)
        except OSError as error:
            raise self._lost(error, f"{what} fails") from None
        return argument

    def _lost(self, error: OSError, words: str) -> CameraLostError:
        if error.errno == errno.EBUSY:
            return CameraLostError(f"{self._path} is in use by another program")
        return CameraLostError(f"{words} ({error.strerror})")

    def _identify(self) -> str:
        capability = abi.Capability()
        try:
            self._kernel.ioctl(self.fd, abi.VIDIOC_QUERYCAP, capability)
        except OSError as error:
            if error.errno in _UNKNOWN:
                raise SourceError(f"{self._path} is no video device") from None
            raise CameraLostError(f"{self._path} does not answer ({error.strerror})") from None
        can = capability.capabilities
        can = capability.device_caps if can & abi.CAP_DEVICE_CAPS else can
        if can & abi.CAP_VIDEO_CAPTURE_MPLANE and not can & abi.CAP_VIDEO_CAPTURE:
            raise SourceError(f"{self._path} is a raw sensor or codec (multi-planar), not a finished camera")
        if not can & abi.CAP_VIDEO_CAPTURE or not can & abi.CAP_STREAMING:
            raise SourceError(
                f"{self._path} takes no pictures: a camera often has two devices, use the other one "
                "(v4l2-ctl --list-devices)"
            )
        return bytes(capability.card).split(b"\0", 1)[0].decode("utf-8", "replace")

    def formats(self) -> list[str]:
        """Names of the pixel formats it offers."""
        names: list[str] = []
        while len(names) < 64:
            entry = abi.FmtDesc(index=len(names), type=abi.BUF_TYPE_VIDEO_CAPTURE)
            try:
                self._kernel.ioctl(self.fd, abi.VIDIOC_ENUM_FMT, entry)
            except OSError as error:
                if error.errno in _UNKNOWN:
                    break
                raise CameraLostError(f"listing the formats fails ({error.strerror})") from None
            names.append(abi.fourcc_name(entry.pixelformat))
        return names

    def set_format(self, width: int, height: int, pixels: str) -> None:
        """Asks for a size and format; what it made of that, :meth:`mode` tells."""
        asked = abi.Format(type=abi.BUF_TYPE_VIDEO_CAPTURE)
        asked.fmt.pix = abi.PixFormat(width, height, abi.fourcc(pixels), abi.FIELD_NONE)
        self.call(abi.VIDIOC_S_FMT, asked, "setting the size")

    def claim(self) -> None:
        """Sets the size that it has: refused where another program has the camera, whose settings stay."""
        now = abi.Format(type=abi.BUF_TYPE_VIDEO_CAPTURE)
        self.call(abi.VIDIOC_G_FMT, now, "reading the size")
        self.call(abi.VIDIOC_S_FMT, now, "setting the size")

    def set_rate(self, rate_hz: float) -> None:
        """Asks for a rate; a driver without that setting is let be."""
        asked = abi.StreamParm(type=abi.BUF_TYPE_VIDEO_CAPTURE)
        asked.timeperframe = abi.Fract(1000, round(rate_hz * 1000))
        try:
            self._kernel.ioctl(self.fd, abi.VIDIOC_S_PARM, asked)
        except OSError as error:
            if error.errno not in _UNKNOWN:
                raise CameraLostError(f"setting the rate fails ({error.strerror})") from None

    def mode(self) -> Mode:
        """Reads back what the camera is set to."""
        found = self.call(
            abi.VIDIOC_G_FMT, abi.Format(type=abi.BUF_TYPE_VIDEO_CAPTURE), "reading the size back"
        )
        parameters, rate_hz = abi.StreamParm(type=abi.BUF_TYPE_VIDEO_CAPTURE), 0.0
        try:
            self._kernel.ioctl(self.fd, abi.VIDIOC_G_PARM, parameters)
            time = parameters.timeperframe
            if parameters.capability & abi.CAP_TIMEPERFRAME and time.numerator:
                rate_hz = time.denominator / time.numerator
        except OSError as error:
            if error.errno not in _UNKNOWN:
                raise CameraLostError(f"reading the rate back fails ({error.strerror})") from None
        pix = found.fmt.pix
        named = abi.fourcc_name(pix.pixelformat)
        return Mode(
            pix.width, pix.height, named, pix.bytesperline, rate_hz, pix.field in abi.INTERLACED,
            pix.field in abi.STACKED,
        )

    def control_range(self, control: int) -> tuple[int, int] | None:
        """Least and greatest value of a control; None where the camera has it not, or doesn't tell."""
        query = abi.QueryCtrl(id=control)
        try:
            self._kernel.ioctl(self.fd, abi.VIDIOC_QUERYCTRL, query)
        except OSError as error:
            if error.errno == errno.ENODEV:
                raise CameraLostError(f"{self._path} is gone") from None
            return None  # the firmware of many stalls (EIO) at controls that it lists
        return None if query.flags & abi.CTRL_FLAG_DISABLED else (query.minimum, query.maximum)

    def set_control(self, control: int, value: int) -> bool:
        """Whether the camera took the value; what it made of it, :meth:`control` tells."""
        try:
            self._kernel.ioctl(self.fd, abi.VIDIOC_S_CTRL, abi.Control(control, value))
        except OSError as error:
            if error.errno == errno.ENODEV:
                raise CameraLostError(f"{self._path} is gone") from None
            return False
        return True

    def control(self, control: int) -> int:
        """The value that a control has."""
        return int(self.call(abi.VIDIOC_G_CTRL, abi.Control(control, 0), "reading a control back").value)

    def stream(self, on: bool) -> None:
        """Starts or stops the flow of images."""
        kind = ctypes.c_int(abi.BUF_TYPE_VIDEO_CAPTURE)
        code = abi.VIDIOC_STREAMON if on else abi.VIDIOC_STREAMOFF
        try:
            self._kernel.ioctl(self.fd, code, kind)
        except OSError as error:
            if error.errno == errno.ENOSPC:
                raise SourceError(
                    f"{self._path}: the USB bus has no room for its images: use format=MJPG, a smaller size, "
                    "or another USB controller"
                ) from None
            raise self._lost(error, "starting the stream fails") from None

    def close(self) -> None:
        """Gives the descriptor back."""
        self._kernel.close(self.fd)
