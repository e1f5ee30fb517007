"""The recipes of docs/SOURCES.md, run as they stand there, on tiny folders laid out as those datasets are."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sources import tiny_datasets as tiny
from sources.opening import all_of, opened

from prism_edge.geometry.poses import from_rt, quaternion_from_rotation, so3_exp
from prism_edge.sources.truth import read_truth

PAGE = Path(__file__).resolve().parents[2] / "docs" / "SOURCES.md"
# A camera that turns to its right, walks ahead and comes down: of the optical camera, whose world is alike.
TURNED = from_rt(so3_exp(np.array([0.1, 0.7, -0.2])), np.array([0.5, 0.2, 3.0]))
POSES = [np.eye(4), TURNED, TURNED @ TURNED]


@pytest.fixture(scope="module")
def recipes() -> dict[str, Any]:
    section = PAGE.read_text(encoding="utf-8").split("## Another dataset\n")[1].split("\n## ")[0]
    (code,) = re.findall(r"```python\n(.*?)```", section, re.DOTALL)
    names: dict[str, Any] = {}
    exec(code, names)
    return names


def images(folder: Path, names: list[str]) -> None:
    for i, name in enumerate(names):
        tiny.write_image(folder / name, tiny.picture(i))


def words(pose: np.ndarray) -> list[float]:
    return [*pose[:3, 3], *quaternion_from_rotation(pose[:3, :3])]


def relative(folder: Path) -> np.ndarray:
    """The motions of the truth that is read, of a folder that plays: axes of the world don't count."""
    (folder / "camera.yaml").write_text(tiny.CAMERA)
    played = [item.stamp_ns for item in all_of(opened(folder))]
    truth = read_truth(str(folder))
    assert truth is not None
    assert set(truth[0].tolist()) <= set(played)
    return np.linalg.inv(truth[1][0]) @ truth[1]


def test_euroc(tmp_path: Path, recipes: dict[str, Any]) -> None:
    stamps = [1403636579763555584 + i * 50_000_000 for i in range(3)]
    images(tmp_path / "cam0" / "data", [f"{stamp}.png" for stamp in stamps])
    imu_from_camera = from_rt(so3_exp(np.array([0.0, 0.0, 1.57])), np.array([-0.02, -0.06, 0.01]))
    numbers = ", ".join(map(str, imu_from_camera.ravel().tolist()))
    (tmp_path / "cam0" / "sensor.yaml").write_text(f"T_BS:\n  cols: 4\n  rows: 4\n  data: [{numbers}]\n")
    rows = ["#timestamp, p_RS_R_x [m], ..."]
    for stamp, pose in zip(stamps, POSES, strict=True):
        *position, x, y, z, w = words(pose @ np.linalg.inv(imu_from_camera))
        rows.append(",".join(map(str, [stamp, *position, w, x, y, z, 0.0, 0.0])))
    (tmp_path / "state_groundtruth_estimate0").mkdir()
    (tmp_path / "state_groundtruth_estimate0" / "data.csv").write_text("\n".join(rows) + "\n")
    recipes["euroc"](tmp_path)
    np.testing.assert_allclose(relative(tmp_path), POSES, atol=1e-6)


def test_kitti_raw(tmp_path: Path, recipes: dict[str, Any]) -> None:
    images(tmp_path / "image_02" / "data", [f"{i:010d}.png" for i in range(2)])
    times = "1970-01-01 00:00:01.000000000\n1970-01-01 00:00:01.104875904\n"
    (tmp_path / "image_02" / "timestamps.txt").write_text(times)
    recipes["kitti_raw"](tmp_path)
    (tmp_path / "camera.yaml").write_text(tiny.CAMERA)
    assert [item.stamp_ns for item in all_of(opened(tmp_path))] == [1_000_000_000, 1_104_875_904]
    assert read_truth(str(tmp_path)) is None


def test_tartanair(tmp_path: Path, recipes: dict[str, Any]) -> None:
    """North is ahead, east to the right, down below."""
    images(tmp_path / "image_left", [f"{i:06d}_left.png" for i in range(3)])
    rows = [words(pose)[:7] for pose in POSES]
    ned = [[z, x, y, qz, qx, qy, qw] for x, y, z, qx, qy, qz, qw in rows]
    np.savetxt(tmp_path / "pose_left.txt", ned, fmt="%.9f")
    recipes["tartanair"](tmp_path)
    np.testing.assert_allclose(relative(tmp_path), POSES, atol=1e-6)


def test_icl_nuim(tmp_path: Path, recipes: dict[str, Any]) -> None:
    """Of a point p the dataset has (x, -y, z), seen from a camera that is written likewise."""
    images(tmp_path / "rgb", ["1.png", "2.png", "10.png"])
    point, rows = np.array([0.3, -0.2, 5.0, 1.0]), []
    up = np.diag([1.0, -1.0, 1.0, 1.0])
    for number, pose in zip((1, 2, 10), POSES, strict=True):
        theirs = up @ pose @ up
        seen = np.linalg.inv(theirs) @ up @ point
        np.testing.assert_allclose(-480.0 * seen[1], 480.0 * (np.linalg.inv(pose) @ point)[1], atol=1e-9)
        rows.append([number, *words(theirs)])
    np.savetxt(tmp_path / "livingRoom.gt.freiburg", rows, fmt="%.9f")
    recipes["icl_nuim"](tmp_path, tmp_path / "livingRoom.gt.freiburg")
    np.testing.assert_allclose(relative(tmp_path), POSES, atol=1e-6)


def test_scannet(tmp_path: Path, recipes: dict[str, Any]) -> None:
    images(tmp_path / "color", [f"{i}.jpg" for i in range(4)])
    (tmp_path / "pose").mkdir()
    for i, pose in enumerate([*POSES, np.full((4, 4), -np.inf)]):
        np.savetxt(tmp_path / "pose" / f"{i}.txt", pose)
    recipes["scannet"](tmp_path)
    np.testing.assert_allclose(relative(tmp_path), POSES, atol=1e-6)
