"""The benchmark through the real daemon, on a generated room laid out as each dataset is."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from prism_edge.evaluation.trajectory import Trajectory, read_tum, write_tum
from prism_edge.geometry.cameras import Camera
from prism_edge.sources.bonn import camera_from_markers
from prism_edge.sources.camera_file import read_camera
from prism_edge.sources.truth import read_truth
from tests.synthetic.network import write_tiny_network
from tests.synthetic.sequence import write_sequence
from tests.tools.test_benchmark import row
from tools import benchmark

FRAMES = 30


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_sequence(tmp_path_factory.mktemp("room"), FRAMES, 320, 240)


def images(room: Path) -> list[Path]:
    return [room / line.split()[1] for line in (room / "rgb.txt").read_text().splitlines()[1:]]


def poses(room: Path) -> np.ndarray:
    truth = read_truth(str(room))
    assert truth is not None
    return truth[1]


def as_tum(room: Path, folder: Path) -> Path:
    shutil.copytree(room, folder)
    return folder


def as_bonn(room: Path, folder: Path) -> Path:
    """Its groundtruth.txt holds the markers' poses: the chain that leads to the camera, undone."""
    turned = np.linalg.inv(camera_from_markers(np.eye(4)))
    ros = np.array([[-1.0, 0, 0, 0], [0, 0, 1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
    truth = read_tum(as_tum(room, folder) / "groundtruth.txt")
    write_tum(folder / "groundtruth.txt", Trajectory(truth.stamps, ros @ truth.poses @ turned @ ros))
    return folder


def as_seven_scenes(room: Path, folder: Path) -> Path:
    folder.mkdir(parents=True)
    for i, (image, pose) in enumerate(zip(images(room), poses(room), strict=True)):
        shutil.copy(image, folder / f"frame-{i:06d}.color.png")
        np.savetxt(folder / f"frame-{i:06d}.pose.txt", pose)
    shutil.copy(room / "camera.yaml", folder)
    return folder


def as_kitti(room: Path, folder: Path) -> Path:
    (folder / "image_2").mkdir(parents=True)
    for i, image in enumerate(images(room)):
        shutil.copy(image, folder / "image_2" / f"{i:06d}.png")
    camera: Camera = read_camera(room / "camera.yaml")
    matrix = f"{camera.fx} 0 {camera.cx} 0 0 {camera.fy} {camera.cy} 0 0 0 1 0"
    (folder / "calib.txt").write_text(f"P0: {matrix}\nP2: {matrix}\n")
    (folder / "times.txt").write_text("".join(f"{i / 30:.6e}\n" for i in range(FRAMES)))
    np.savetxt(folder / "poses.txt", poses(room)[:, :3].reshape(-1, 12))
    return folder


LAYOUTS = {
    "rgbd_dataset_freiburg3_walking_xyz": (as_tum, "### TUM RGB-D", "-", 1.0),
    "rgbd_bonn_balloon": (as_bonn, "### BONN Dynamic", "9.8 / 18.1†", 1.0),
    "chess/seq-01": (as_seven_scenes, "### 7-Scenes", "-", 1.0),
    "sequences/03": (as_kitti, "### KITTI odometry", "-", 0.01),  # metres, not centimetres
}


@pytest.mark.slow
@pytest.mark.parametrize("name", LAYOUTS)
def test_each_layout_is_played_scored_and_put_into_its_table(
    name: str, room: Path, tmp_path: Path, capsys
) -> None:
    lay, heading, paper, unit = LAYOUTS[name]
    network = write_tiny_network(tmp_path / "tiny.onnx")
    words = [str(lay(room, tmp_path / name)), "--model", str(network), "--lockstep"]
    assert benchmark.main([*words, "--out", str(tmp_path / "out")]) == 0
    out = capsys.readouterr().out
    assert heading in out
    cells = row(out, name)
    assert cells[1] == str(FRAMES)
    assert float(cells[3]) >= 0.85, "coverage"
    for ours in cells[5:7]:
        sim3, se3 = map(float, ours.split(" / "))
        assert 0.0 <= sim3 <= 2.0 * unit
        assert 0.0 <= se3 <= 5.0 * unit
    assert cells[-2] == paper
    assert (f"has {FRAMES} frames, and the paper's figures are of" in out) == (paper == "-")
