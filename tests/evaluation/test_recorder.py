"""The camera's pose from published messages, written as they come."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from prism_edge.bus import ros
from prism_edge.config import FramesConfig
from prism_edge.evaluation.recorder import PoseRecorder, camera_pose
from prism_edge.evaluation.trajectory import read_tum
from prism_edge.geometry.mount import base_from_camera
from prism_edge.geometry.poses import from_rt


def message(stamp_ns: int, pose: np.ndarray) -> Any:
    """As it comes off the wire."""
    data = ros.serialise(ros.POSE, ros.pose_with_covariance(stamp_ns, "map", pose, np.eye(6)))
    return ros.deserialise(ros.POSE, data)


def strange_message(x: float, w: float) -> Any:
    """One that our own publisher would refuse to send."""
    zero = {"y": 0.0, "z": 0.0}
    turn = SimpleNamespace(x=0.0, w=w, **zero)
    pose = SimpleNamespace(position=SimpleNamespace(x=x, **zero), orientation=turn)
    stamp = SimpleNamespace(sec=1, nanosec=0)
    return SimpleNamespace(header=SimpleNamespace(stamp=stamp), pose=SimpleNamespace(pose=pose))


def test_the_default_camera_looks_where_the_robot_goes() -> None:
    mount = base_from_camera(FramesConfig())
    np.testing.assert_allclose(mount[:3, :3] @ [0, 0, 1], [1, 0, 0], atol=1e-12)  # optical z: forward
    np.testing.assert_allclose(mount[:3, :3] @ [1, 0, 0], [0, -1, 0], atol=1e-12)  # right: not left
    np.testing.assert_allclose(mount[:3, :3] @ [0, 1, 0], [0, 0, -1], atol=1e-12)  # down: not up


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**31 * 10**9 - 1), st.integers(0, 2**32 - 1))
def test_the_cameras_pose_is_the_robots_times_the_mount(stamp_ns: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    rotations = Rotation.random(2, rng=rng)
    map_from_base = from_rt(rotations[0].as_matrix(), rng.normal(size=3))
    frames = FramesConfig(
        base_from_camera_xyz=tuple(rng.normal(size=3)), base_from_camera_xyzw=tuple(rotations[1].as_quat())
    )
    stamp, pose = camera_pose(message(stamp_ns, map_from_base), base_from_camera(frames))
    assert stamp == stamp_ns
    # A point at the camera's origin, through the robot into the map.
    on_robot = np.array(frames.base_from_camera_xyz)
    np.testing.assert_allclose(
        pose[:3, 3], map_from_base[:3, :3] @ on_robot + map_from_base[:3, 3], atol=1e-9
    )
    turned = (rotations[0] * rotations[1]).as_matrix()
    np.testing.assert_allclose(pose[:3, :3], turned, atol=1e-9)


def test_poses_are_in_the_file_as_soon_as_they_are_recorded(tmp_path: Path) -> None:
    mount = base_from_camera(FramesConfig())
    inverse_mount = np.linalg.inv(mount)
    with PoseRecorder(tmp_path / "r.tum", lambda: mount) as recorder:
        for i in range(3):
            pose = from_rt(np.eye(3), np.array([i, 2.0, 3.0]))
            recorder.record(message(i * 10**9, pose @ inverse_mount))
            written = read_tum(tmp_path / "r.tum")  # still open
            assert len(written) == recorder.count == i + 1
        recorder.record(strange_message(np.nan, 1.0))
        recorder.record(strange_message(0.0, 0.0))
    assert recorder.count == 3
    np.testing.assert_allclose(read_tum(tmp_path / "r.tum").poses[2], pose, atol=1e-8)


def test_a_file_that_cannot_be_made_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"absent/r\.tum"):
        PoseRecorder(tmp_path / "absent" / "r.tum", lambda: np.eye(4))


def test_a_new_file_that_no_pose_came_for_is_none(tmp_path: Path) -> None:
    new, old, link = tmp_path / "new.tum", tmp_path / "old.tum", tmp_path / "latest.tum"
    link.symlink_to("later.tum")
    old.write_text("# mine\n")
    for path in (new, old, link):
        with PoseRecorder(path, lambda: np.eye(4)) as recorder:
            recorder.record(strange_message(np.nan, 1.0))
    assert not new.exists()
    assert old.exists()
    assert link.is_symlink()


@pytest.mark.parametrize(("append", "kept"), [({}, 0), ({"append": False}, 0), ({"append": True}, 1)])
def test_a_file_begins_anew_unless_it_is_to_go_on(tmp_path: Path, append: dict[str, bool], kept: int) -> None:
    path = tmp_path / "r.tum"
    path.write_text("1.000000000 0 0 0 0 0 0 1\n")
    with PoseRecorder(path, lambda: np.eye(4), **append) as recorder:
        recorder.record(message(2 * 10**9, np.eye(4)))
    assert len(read_tum(path)) == kept + 1
