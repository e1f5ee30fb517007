"""BONN's truth is the markers': what is read is the camera's."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from sources import tiny_datasets as tiny

from prism_edge.evaluation.scores import score
from prism_edge.evaluation.trajectory import Trajectory, read_tum, write_tum
from prism_edge.geometry.poses import from_rt, inverse, so3_exp
from prism_edge.sources.bonn import camera_from_markers
from prism_edge.sources.truth import read_truth

ROS = np.array([[-1.0, 0, 0, 0], [0, 0, 1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
SCALED = np.array([[1.0157, 0.1828, -0.2389], [0.0009, -0.8431, -0.6413], [-0.3009, 0.6147, -0.8085]])


def markers_from_camera() -> np.ndarray:
    """T_ROS T_m, the nearest rotation by Newton's iteration: the mean with the inverse's transpose."""
    turn = SCALED / 1.0593
    for _ in range(5):
        turn = 0.5 * (turn + np.linalg.inv(turn).T)
    assert np.abs(turn - SCALED / 1.0593).max() < 1e-4
    return ROS @ from_rt(turn, np.array([0.0113, -0.0098, 0.0111]))


def camera_path(count: int = 40) -> Trajectory:
    """A camera that goes round and turns about all its axes."""
    rows = []
    for i in range(count):
        a = 0.1 * i
        turn = so3_exp(np.array([0.3 * np.sin(a), a, 0.2 * np.cos(2 * a)]))
        pose = from_rt(turn, np.array([a, np.sin(a), 1.0]))
        rows.append((1_305_031_102_000_000_000 + i * 100_000_000, pose))
    return Trajectory.of(rows)


def published(folder: Path, path: Trajectory) -> Path:
    """A sequence whose groundtruth.txt is what BONN would have written of a camera's path."""
    tiny.write_tum(folder, count=2)
    markers = np.array([ROS @ pose @ inverse(markers_from_camera()) for pose in path.poses])
    write_tum(folder / "groundtruth.txt", Trajectory(path.stamps, markers))
    return folder


def test_the_path_of_the_camera_comes_back(tmp_path: Path) -> None:
    path = camera_path()
    truth = read_truth(str(published(tmp_path / "rgbd_bonn_balloon", path)))
    assert truth is not None
    assert truth[0].tolist() == path.stamps.tolist()
    np.testing.assert_allclose(truth[1], path.poses, atol=1e-8)
    errors = score(path, Trajectory(*truth))
    assert errors.rpe_rot_deg == pytest.approx(0.0, abs=1e-6)
    assert errors.rpe_trans_m == pytest.approx(0.0, abs=1e-7)


def test_poses_stay_poses() -> None:
    poses = camera_from_markers(camera_path().poses)
    turned = poses[:, :3, :3]
    upright = np.broadcast_to(np.eye(3), turned.shape)
    np.testing.assert_allclose(turned @ turned.transpose(0, 2, 1), upright, atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(turned), 1.0)


@pytest.mark.parametrize("name", ["balloon", "rgbd_dataset_freiburg1_desk", "rgbd_bonn", "my_rgbd_bonn_x"])
def test_other_folders_hold_the_cameras_poses(tmp_path: Path, name: str) -> None:
    path = camera_path()
    folder = tiny.write_tum(tmp_path / "rgbd_bonn_dataset" / name, count=2)
    write_tum(folder / "groundtruth.txt", path)
    truth = read_truth(str(folder))
    assert truth is not None
    np.testing.assert_allclose(truth[1], path.poses, atol=1e-8)


@pytest.mark.parametrize(("name", "warned"), [("bonn_balloon", 1), ("rgbd_bonn_balloon", 0), ("desk", 0)])
def test_its_camera_without_its_name_is_warned_of(
    tmp_path: Path, name: str, warned: int, caplog: pytest.LogCaptureFixture
) -> None:
    folder = tiny.write_tum(tmp_path / name)
    (folder / "groundtruth.txt").write_text("1.0 0 0 0 0 0 0 1\n")
    assert read_truth(str(folder)) is not None
    assert sum("not called rgbd_bonn_*" in record.message for record in caplog.records) == warned


def test_the_folder_goes_by_its_name_from_within_and_through_a_link(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = camera_path()
    folder = published(tmp_path / "rgbd_bonn_Balloon", path)
    (tmp_path / "balloon").symlink_to(folder)
    monkeypatch.chdir(folder)
    for uri in (".", "rgb/..", str(tmp_path / "balloon")):
        truth = read_truth(uri)
        assert truth is not None
        np.testing.assert_allclose(truth[1], path.poses, atol=1e-8)


def test_a_file_that_is_given_is_taken_as_it_is(tmp_path: Path) -> None:
    """`--truth` reads by `read_tum`, also the folder's own file: for figures against what papers score."""
    file = published(tmp_path / "rgbd_bonn_balloon", camera_path()) / "groundtruth.txt"
    np.testing.assert_allclose(
        read_tum(file).poses[0], ROS @ camera_path().poses[0] @ inverse(markers_from_camera()), atol=1e-8
    )
