"""`prism-edge map show` of maps that two cameras made."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from prism_edge.cli.main import main
from tests.cli.mapped_room import CAMERA, true_map
from tests.synthetic.sequence import synthetic_camera


def cameras_of(data: bytes, folder: Path, capsys: pytest.CaptureFixture[str]) -> str:
    path = folder / "both.prismmap"
    path.write_bytes(data)
    assert main(["map", "show", str(path)]) == 0
    return next(line for line in capsys.readouterr().out.splitlines() if line.startswith("cameras"))


def test_cameras_of_one_size_are_told_apart(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    other = replace(CAMERA, fx=210.0, fy=211.5)
    said = cameras_of(true_map(twice=True, other=other), tmp_path, capsys)
    for camera in (CAMERA, other):
        lengths = f"focal length {camera.fx:.1f} and {camera.fy:.1f} pixels"
        assert f"pinhole 320x240, {lengths} (8 keyframes)" in said


def test_cameras_of_two_sizes_are_by_these(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    said = cameras_of(true_map(twice=True, other=synthetic_camera(640, 480)), tmp_path, capsys)
    assert said.endswith("pinhole 320x240 (8 keyframes), pinhole 640x480 (8 keyframes)")
