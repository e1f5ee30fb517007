"""Recordings through another lens: what is seen must be where the lens's camera has its rays."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from prism_edge.config import SourceConfig
from prism_edge.errors import SourceError
from prism_edge.evaluation.trajectory import read_tum
from prism_edge.geometry.cameras import FISHEYE, PINHOLE, Camera
from prism_edge.sources import open_source
from prism_edge.sources.camera_file import read_camera
from prism_edge.sources.sensor_depth import SensorDepth
from prism_edge.sources.sim import SimSource
from tests.sources import tiny_datasets as tiny
from tests.synthetic.sequence import write_sequence
from tools import make_lens
from tools.make_lens import Lens, write

STRAIGHT = Camera(640, 480, 300.0, 300.0, 319.5, 239.5)
BENT = Camera(200, 150, 100.0, 99.0, 100.0, 74.0, PINHOLE, (-0.2, 0.03, 0.0, 0.0))
FISH = Camera(200, 150, 68.0, 68.0, 99.5, 74.5, FISHEYE, (-0.01, 0.002, 0.0, 0.0))
LENS_FILE = "model: fisheye\nwidth: 80\nheight: 60\nfx: 40\nfy: 40\ncx: 39.5\ncy: 29.5\n"


@pytest.fixture
def lens_file(tmp_path: Path) -> Path:
    path = tmp_path / "lens.yaml"
    path.write_text(LENS_FILE)
    return path


@pytest.mark.parametrize("camera", [BENT, FISH], ids=["pinhole", "fisheye"])
def test_points_come_where_the_lens_projects_them(camera: Camera) -> None:
    """Soft dots drawn where an ideal camera sees points, looked for where the lens does."""
    lens = Lens(STRAIGHT, camera)
    row, column = np.mgrid[:480, :640]
    for ray in ((0.0, 0.0, 1.0), (0.5, -0.3, 1.0), (-0.7, 0.4, 1.0)):
        point = np.array([ray])
        (u, v), = STRAIGHT.project(point)
        picture = 255.0 * np.exp(-((column - u) ** 2 + (row - v) ** 2) / 50.0)
        seen = lens.image(picture.astype(np.uint8)).astype(np.float64)
        weight = seen / seen.sum()
        at = [(weight * np.arange(200)).sum(), (weight.T * np.arange(150)).sum()]
        assert at == pytest.approx(camera.project(point)[0], abs=0.25)  # a dot is bent itself


def test_depth_stays_along_the_axis_and_is_not_mixed() -> None:
    metres = np.where(np.arange(640) < 320, 2.0, 5.0)[None].repeat(480, axis=0).astype(np.float32)
    seen = Lens(STRAIGHT, BENT).depth(metres)
    assert set(np.unique(seen)) <= {0.0, 2.0, 5.0}
    half = Lens(STRAIGHT, BENT).depth(metres[::2, ::2])  # a depth camera of fewer pixels
    assert np.mean(half == seen) > 0.98
    assert seen[74, 62] == 2.0
    assert seen[74, 138] == 5.0


def test_what_the_recording_does_not_show_is_black() -> None:
    wide = Camera(320, 240, 60.0, 60.0, 159.5, 119.5, FISHEYE)  # 150 degrees across
    seen = Lens(STRAIGHT, wide).image(np.full((480, 640), 200, np.uint8))
    assert seen[119, 159] == 200
    assert seen[119, 2] == seen[2, 159] == 0


def test_a_recording_keeps_its_stamps_and_poses(tmp_path: Path, lens_file: Path) -> None:
    source, out = write_sequence(tmp_path / "in", frames=4, width=160, height=120), tmp_path / "out"
    truth = source / "groundtruth.txt"
    assert write(str(source), read_camera(lens_file), out, poses=truth) == 4
    for file in ("groundtruth.txt", "reference.tum"):
        was, now = read_tum(truth), read_tum(out / file)
        assert now.stamps == pytest.approx(was.stamps)
        assert now.poses == pytest.approx(was.poses, abs=1e-6)
    with open_source(SourceConfig(uri=str(out), camera=str(lens_file))) as played:
        image = played.read()
    assert image.pixels.shape[:2] == (60, 80)
    assert image.pixels.std() > 5.0


def test_a_simulated_world_has_its_depth_too(tmp_path: Path, lens_file: Path) -> None:
    uri, out = "sim:room?seed=3&width=160&height=120&focal=60&frames=3", tmp_path / "out"
    lens = read_camera(lens_file)
    assert write(uri, lens, out, count=2) == 2
    seen = SensorDepth(out)
    assert len(seen) == 2
    with SimSource(uri) as world:
        for index in range(2):
            expected = Lens(world.camera, lens).depth(world.depth(index))
            assert seen.in_colour(index, lens) == pytest.approx(expected, abs=2e-4)


def test_the_command_says_what_it_wrote_and_copies_the_camera(tmp_path: Path, lens_file: Path) -> None:
    folder, out = tiny.write_tum(tmp_path / "seq"), tmp_path / "out"
    command = [sys.executable, make_lens.__file__, str(folder), str(lens_file), str(out), "--count", "1"]
    said = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert said == f"1 images in {out}\n"
    assert (out / "camera.yaml").read_text() == LENS_FILE


def test_what_can_not_be_taken_is_refused(tmp_path: Path, lens_file: Path) -> None:
    lens = read_camera(lens_file)
    full = tmp_path / "full"
    full.mkdir()
    (full / "notes.txt").write_text("mine")
    folder = tiny.write_tum(tmp_path / "seq")
    with pytest.raises(SourceError, match="not empty"):
        write(str(folder), lens, full)
    with pytest.raises(SourceError):
        write(str(tmp_path / "nowhere"), lens, tmp_path / "out1")
    bent = tmp_path / "images"
    bent.mkdir()
    assert cv2.imwrite(str(bent / "0.png"), tiny.picture(0))
    (bent / "camera.yaml").write_text(tiny.CAMERA + "distortion: [-0.1, 0, 0, 0]\n")
    with pytest.raises(SystemExit, match="distortion"):
        write(str(bent), lens, tmp_path / "out2")
