"""Structures and codes against the kernel's own header, as its compiler sees it."""

from __future__ import annotations

import ctypes
import shutil
import struct
import subprocess
from pathlib import Path

import pytest

from prism_edge.sources.live import v4l2_abi as abi

STRUCTS = {
    "v4l2_capability": abi.Capability,
    "v4l2_fmtdesc": abi.FmtDesc,
    "v4l2_pix_format": abi.PixFormat,
    "v4l2_format": abi.Format,
    "v4l2_streamparm": abi.StreamParm,
    "v4l2_requestbuffers": abi.RequestBuffers,
    "v4l2_buffer": abi.Buffer,
    "v4l2_queryctrl": abi.QueryCtrl,
    "v4l2_control": abi.Control,
}
CODES = [name for name in dir(abi) if name.startswith("VIDIOC_")]
CONSTANTS = [name for name in dir(abi) if name.startswith(("CAP_", "BUF_", "CTRL_", "CID_", "MEMORY_"))]


def test_codes_as_the_64_bit_kernel_has_them() -> None:
    if struct.calcsize("P") != 8:
        pytest.skip("a 32-bit machine has other codes")
    # Read off linux/videodev2.h by a C compiler; they contain the sizes of the structures.
    assert abi.VIDIOC_QUERYCAP == 0x80685600
    assert abi.VIDIOC_ENUM_FMT == 0xC0405602
    assert abi.VIDIOC_S_FMT == 0xC0D05605
    assert abi.VIDIOC_S_PARM == 0xC0CC5616
    assert abi.VIDIOC_REQBUFS == 0xC0145608
    assert abi.VIDIOC_DQBUF == 0xC0585611
    assert abi.VIDIOC_STREAMON == 0x40045612
    assert abi.VIDIOC_S_CTRL == 0xC008561C
    assert abi.VIDIOC_QUERYCTRL == 0xC0445624
    assert (abi.Buffer.timestamp.offset, abi.Buffer.sequence.offset, abi.Buffer.m.offset) == (24, 56, 64)
    assert abi.Format.fmt.offset == 8


def test_everything_as_the_header_has_it(tmp_path: Path) -> None:
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        pytest.skip("no C compiler to read linux/videodev2.h with")
    expressions: dict[str, int] = {}
    for name, kind in STRUCTS.items():
        expressions[f"sizeof(struct {name})"] = ctypes.sizeof(kind)
        for entry in kind._fields_:
            if not entry[0].startswith(("reserved", "rest", "raw", "align")) and name != "v4l2_streamparm":
                expressions[f"offsetof(struct {name}, {entry[0]})"] = getattr(kind, entry[0]).offset
    start = "offsetof(struct v4l2_streamparm, parm.capture."
    for member in ("capability", "timeperframe", "readbuffers"):
        expressions[f"{start}{member})"] = getattr(abi.StreamParm, member).offset
    expressions |= {name: getattr(abi, name) for name in CODES}
    expressions |= {f"V4L2_{name}": getattr(abi, name) for name in CONSTANTS if "TYPE" not in name}
    source = tmp_path / "sizes.c"
    lines = "\n".join(f'printf("%llu\\n", (unsigned long long)(unsigned)({e}));' for e in expressions)
    headers = "".join(f"#include <{name}.h>\n" for name in ("linux/videodev2", "stddef", "stdio"))
    source.write_text(f"{headers}int main(void){{\n{lines}\n}}\n")
    program = tmp_path / "sizes"
    built = subprocess.run([compiler, "-o", program, source], capture_output=True, text=True)
    if "linux/videodev2.h" in built.stderr:
        pytest.skip("no kernel headers: linux/videodev2.h is missing")
    assert built.returncode == 0, built.stderr
    found = subprocess.run([program], capture_output=True, text=True, check=True).stdout.split()
    assert dict(zip(expressions, map(int, found), strict=True)) == expressions
