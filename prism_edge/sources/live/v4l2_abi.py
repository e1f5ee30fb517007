"""The part of Linux's Video4Linux interface (linux/videodev2.h) that capturing takes: structures and codes.

Names are the kernel's. `unsigned long` sizes itself, so this holds on 32 bits with the old 32-bit time too.
"""

from __future__ import annotations

import ctypes
from ctypes import c_int32, c_long, c_uint8, c_uint32, c_ulong

CAP_VIDEO_CAPTURE, CAP_VIDEO_CAPTURE_MPLANE = 0x1, 0x1000
CAP_STREAMING, CAP_DEVICE_CAPS = 0x0400_0000, 0x8000_0000
BUF_TYPE_VIDEO_CAPTURE, MEMORY_MMAP, FIELD_NONE = 1, 1, 1
INTERLACED = (4, 5, 6, 7, 8, 9)  # field orders of images whose rows were taken at two times
STACKED = (5, 6)  # ... and where one such half stands above the other
CAP_TIMEPERFRAME = 0x1000
BUF_FLAG_ERROR, BUF_FLAG_TIMESTAMP_MASK, BUF_FLAG_TIMESTAMP_MONOTONIC = 0x40, 0xE000, 0x2000
CTRL_FLAG_DISABLED = 0x1

CID_GAIN, CID_AUTOGAIN = 0x0098_0913, 0x0098_0912
CID_EXPOSURE_AUTO, CID_EXPOSURE_ABSOLUTE, CID_EXPOSURE_AUTO_PRIORITY = 0x009A_0901, 0x009A_0902, 0x009A_0903
CID_FOCUS_ABSOLUTE, CID_FOCUS_AUTO = 0x009A_090A, 0x009A_090C
EXPOSURE_AUTO, EXPOSURE_MANUAL, EXPOSURE_APERTURE_PRIORITY = 0, 1, 3


class Capability(ctypes.Structure):
    """struct v4l2_capability"""

    _fields_ = (
        ("driver", c_uint8 * 16),
        ("card", c_uint8 * 32),
        ("bus_info", c_uint8 * 32),
        ("version", c_uint32),
        ("capabilities", c_uint32),
        ("device_caps", c_uint32),
        ("reserved", c_uint32 * 3),
    )


class FmtDesc(ctypes.Structure):
    """struct v4l2_fmtdesc"""

    _fields_ = (
        ("index", c_uint32),
        ("type", c_uint32),
        ("flags", c_uint32),
        ("description", c_uint8 * 32),
        ("pixelformat", c_uint32),
        ("mbus_code", c_uint32),
        ("reserved", c_uint32 * 3),
    )


class PixFormat(ctypes.Structure):
    """struct v4l2_pix_format"""

    _fields_ = tuple(
        (name, c_uint32)
        for name in (
            "width",
            "height",
            "pixelformat",
            "field",
            "bytesperline",
            "sizeimage",
            "colorspace",
            "priv",
            "flags",
            "ycbcr_enc",
            "quantization",
            "xfer_func",
        )
    )


class _FormatUnion(ctypes.Union):
    # The pointer stands for other members' pointers: it gives the union its alignment.
    _fields_ = (("pix", PixFormat), ("raw", c_uint8 * 200), ("align", ctypes.c_void_p))


class Format(ctypes.Structure):
    """struct v4l2_format"""

    _fields_ = (("type", c_uint32), ("fmt", _FormatUnion))


class Fract(ctypes.Structure):
    """struct v4l2_fract"""

    _fields_ = (("numerator", c_uint32), ("denominator", c_uint32))


class StreamParm(ctypes.Structure):
    """struct v4l2_streamparm, its union taken for capturing"""

    _fields_ = (
        ("type", c_uint32),
        ("capability", c_uint32),
        ("capturemode", c_uint32),
        ("timeperframe", Fract),
        ("extendedmode", c_uint32),
        ("readbuffers", c_uint32),
        ("reserved", c_uint32 * 4),
        ("rest", c_uint8 * 160),
    )


class RequestBuffers(ctypes.Structure):
    """struct v4l2_requestbuffers"""

    _fields_ = (
        ("count", c_uint32),
        ("type", c_uint32),
        ("memory", c_uint32),
        ("capabilities", c_uint32),
        ("flags", c_uint8),
        ("reserved", c_uint8 * 3),
    )


class TimeVal(ctypes.Structure):
    """struct timeval"""

    _fields_ = (("tv_sec", c_long), ("tv_usec", c_long))


class TimeCode(ctypes.Structure):
    """struct v4l2_timecode"""

    _fields_ = (("type", c_uint32), ("flags", c_uint32), ("rest", c_uint8 * 8))


class _Memory(ctypes.Union):
    _fields_ = (("offset", c_uint32), ("userptr", c_ulong), ("fd", c_int32))


class Buffer(ctypes.Structure):
    """struct v4l2_buffer"""

    _fields_ = (
        ("index", c_uint32),
        ("type", c_uint32),
        ("bytesused", c_uint32),
        ("flags", c_uint32),
        ("field", c_uint32),
        ("timestamp", TimeVal),
        ("timecode", TimeCode),
        ("sequence", c_uint32),
        ("memory", c_uint32),
        ("m", _Memory),
        ("length", c_uint32),
        ("reserved2", c_uint32),
        ("request_fd", c_int32),
    )


class QueryCtrl(ctypes.Structure):
    """struct v4l2_queryctrl"""

    _fields_ = (
        ("id", c_uint32),
        ("type", c_uint32),
        ("name", c_uint8 * 32),
        ("minimum", c_int32),
        ("maximum", c_int32),
        ("step", c_int32),
        ("default_value", c_int32),
        ("flags", c_uint32),
        ("reserved", c_uint32 * 2),
    )


class Control(ctypes.Structure):
    """struct v4l2_control"""

    _fields_ = (("id", c_uint32), ("value", c_int32))


_WRITE, _READ = 1, 2


def _code(direction: int, number: int, kind: type) -> int:
    return direction << 30 | ctypes.sizeof(kind) << 16 | ord("V") << 8 | number


VIDIOC_QUERYCAP = _code(_READ, 0, Capability)
VIDIOC_ENUM_FMT = _code(_READ | _WRITE, 2, FmtDesc)
VIDIOC_G_FMT = _code(_READ | _WRITE, 4, Format)
VIDIOC_S_FMT = _code(_READ | _WRITE, 5, Format)
VIDIOC_REQBUFS = _code(_READ | _WRITE, 8, RequestBuffers)
VIDIOC_QUERYBUF = _code(_READ | _WRITE, 9, Buffer)
VIDIOC_QBUF = _code(_READ | _WRITE, 15, Buffer)
VIDIOC_DQBUF = _code(_READ | _WRITE, 17, Buffer)
VIDIOC_STREAMON = _code(_WRITE, 18, ctypes.c_int)
VIDIOC_STREAMOFF = _code(_WRITE, 19, ctypes.c_int)
VIDIOC_G_PARM = _code(_READ | _WRITE, 21, StreamParm)
VIDIOC_S_PARM = _code(_READ | _WRITE, 22, StreamParm)
VIDIOC_G_CTRL = _code(_READ | _WRITE, 27, Control)
VIDIOC_S_CTRL = _code(_READ | _WRITE, 28, Control)
VIDIOC_QUERYCTRL = _code(_READ | _WRITE, 36, QueryCtrl)


def fourcc(name: str) -> int:
    """The kernel's number of a pixel format such as YUYV."""
    return int.from_bytes(name.encode("ascii"), "little")


def fourcc_name(code: int) -> str:
    """The four letters of a pixel format's number."""
    return code.to_bytes(4, "little").decode("latin-1").strip()
