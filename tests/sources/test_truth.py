"""Ground truth and sensor depth of datasets, read by other parts than those that estimate."""

from __future__ import annotations

import ast
import os
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from sources import tiny_datasets as tiny

from prism_edge.errors import ConfigError, SourceError
from prism_edge.geometry.cameras import Camera
from prism_edge.geometry.poses import so3_exp
from prism_edge.sources.known_cameras import SEVEN_SCENES
from prism_edge.sources.open import find_listing
from prism_edge.sources.sensor_depth import SensorDepth
from prism_edge.sources.shrunk import shrunk_camera
from prism_edge.sources.truth import read_truth, truth_file

PACKAGE = Path(__file__).resolve().parents[2] / "prism_edge"


def test_tum(tmp_path: Path) -> None:
    truth = read_truth(str(tiny.write_tum(tmp_path)))
    assert truth is not None
    stamps, poses = truth
    assert stamps[1] == 1305031102275304000
    np.testing.assert_allclose(poses[:, 0, 3], [0.0, 0.1, 0.2, 0.3, 0.4])
    np.testing.assert_allclose(poses[:, :3, :3], np.broadcast_to(np.eye(3), (5, 3, 3)))


@pytest.mark.parametrize(
    ("write", "name"),
    [
        (tiny.write_tum, "groundtruth.txt"),
        (tiny.write_seven_scenes, "."),
        (tiny.write_kitti, "poses.txt"),
        (tiny.write_kitti, "../../poses/03.txt"),
        (tiny.write_images, None),
    ],
)
def test_the_file_of_truth_is_what_is_read(
    tmp_path: Path, write: Callable[[Path], Path], name: str | None
) -> None:
    folder = write(tmp_path / "sequences" / "03")
    if name and name.startswith(".."):
        (tmp_path / "poses").mkdir()
        (folder / "poses.txt").rename(folder / name)
    file = truth_file(folder, find_listing(folder))
    assert file == (Path(os.path.normpath(folder / name)) if name else None)
    assert (read_truth(str(folder)) is None) == (file is None)
    for gone in [] if file is None else folder.glob("*.pose.txt") if file == folder else [file]:
        gone.unlink()
    assert truth_file(folder, find_listing(folder)) is None
    assert read_truth(str(folder)) is None


def test_quaternions_are_x_y_z_w(tmp_path: Path) -> None:
    folder = tiny.write_tum(tmp_path)
    (folder / "groundtruth.txt").write_text("1.0 1 2 3 0 0 0.70710678 0.70710678\n")  # 90 degrees about z
    truth = read_truth(str(folder))
    assert truth is not None
    np.testing.assert_allclose(truth[1][0, :3, :3] @ [1, 0, 0], [0, 1, 0], atol=1e-7)


def test_seven_scenes_leaves_out_what_was_not_tracked(tmp_path: Path) -> None:
    folder = tiny.write_seven_scenes(tmp_path)
    (folder / "frame-000001.pose.txt").write_text("nan nan nan nan\n" * 4)
    (folder / "frame-000003.pose.txt").unlink()
    truth = read_truth(str(folder))
    assert truth is not None
    assert truth[0].tolist() == [0, 66666667]
    # As Windows' programs write what is no number, or no finite one.
    (folder / "frame-000001.pose.txt").write_text("-1.#IND 1.#QNAN -1.#INF000 1.#INF\n" * 4)
    truth = read_truth(str(folder))
    assert truth is not None
    assert truth[0].tolist() == [0, 66666667]
    np.testing.assert_allclose(truth[1][:, 0, 3], [0.0, 0.2])


def test_a_rotation_that_is_a_little_off_is_read_as_the_nearest_one(tmp_path: Path) -> None:
    """7-Scenes' own are 4e-4 off, and angles between them would be, too."""
    tiny.write_seven_scenes(tmp_path, count=2)
    turned = so3_exp(np.array([0.1, -0.4, 0.2]))
    rows = np.eye(4)
    rows[:3, :3] = turned + 3e-4 * np.random.default_rng(0).normal(size=(3, 3))
    np.savetxt(tmp_path / "frame-000001.pose.txt", rows)
    _, poses = read_truth(str(tmp_path))  # type: ignore[misc]
    read = poses[1, :3, :3]
    np.testing.assert_allclose(read @ read.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(read, turned, atol=1e-3)
    away = np.linalg.norm(rows[:3, :3] - read)
    for nudge in 1e-4 * np.random.default_rng(1).normal(size=(20, 3)):
        assert np.linalg.norm(rows[:3, :3] - so3_exp(nudge) @ read) > away


def test_kitti_beside_the_images_or_as_the_benchmark_has_it(tmp_path: Path) -> None:
    folder = tiny.write_kitti(tmp_path / "dataset" / "sequences" / "07")
    inside = read_truth(str(folder))
    (tmp_path / "dataset" / "poses").mkdir()
    (folder / "poses.txt").rename(tmp_path / "dataset" / "poses" / "07.txt")
    beside = read_truth(str(folder))
    assert inside is not None
    assert beside is not None
    np.testing.assert_array_equal(inside[1], beside[1])
    assert inside[0].tolist() == [0, 100000000, 200000000]
    np.testing.assert_allclose(inside[1][:, 2, 3], [0, 1, 2])


@pytest.mark.parametrize(
    ("inside", "uri"), [("06", "../07"), ("07/image_0", ".."), ("07", "."), ("", "06/../07")]
)
def test_kitti_as_the_benchmark_has_it_is_found_from_any_folder(
    inside: str, uri: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tiny.write_kitti(tmp_path / "dataset" / "sequences" / "07")
    (tmp_path / "dataset" / "sequences" / "06").mkdir()
    (tmp_path / "dataset" / "poses").mkdir()
    (folder / "poses.txt").rename(tmp_path / "dataset" / "poses" / "07.txt")
    monkeypatch.chdir(tmp_path / "dataset" / "sequences" / inside)
    assert read_truth(uri) is not None


def test_a_linked_kitti_sequence_goes_by_the_links_name(tmp_path: Path) -> None:
    folder = tiny.write_kitti(tmp_path / "elsewhere" / "raw")
    (tmp_path / "dataset" / "sequences").mkdir(parents=True)
    (tmp_path / "dataset" / "sequences" / "07").symlink_to(folder)
    (tmp_path / "dataset" / "poses").mkdir()
    (folder / "poses.txt").rename(tmp_path / "dataset" / "poses" / "07.txt")
    assert read_truth(str(tmp_path / "dataset" / "sequences" / "07")) is not None


def test_a_link_to_a_kitti_sequence_finds_the_benchmarks_truth_where_it_leads(tmp_path: Path) -> None:
    folder = tiny.write_kitti(tmp_path / "dataset" / "sequences" / "07")
    (tmp_path / "dataset" / "poses").mkdir()
    (folder / "poses.txt").rename(tmp_path / "dataset" / "poses" / "07.txt")
    (tmp_path / "kitti07").symlink_to(folder)
    assert read_truth(str(tmp_path / "kitti07")) is not None


def test_the_benchmarks_truth_comes_before_what_somebody_estimated(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folder = tiny.write_kitti(tmp_path / "dataset" / "sequences" / "07")
    (tmp_path / "dataset" / "poses").mkdir()
    (folder / "poses.txt").rename(tmp_path / "dataset" / "poses" / "07.txt")
    expected = read_truth(str(folder))
    assert not caplog.text
    (folder / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 9\n" * 3)
    found = read_truth(str(folder))
    assert expected is not None
    assert found is not None
    np.testing.assert_array_equal(found[1], expected[1])
    assert "poses.txt is not read" in caplog.text


def test_a_kitti_sequence_that_was_cut_short_has_the_truth_that_fits_it(tmp_path: Path) -> None:
    folder = tiny.write_kitti(tmp_path / "dataset" / "sequences" / "07")
    (tmp_path / "dataset" / "poses").mkdir()
    (tmp_path / "dataset" / "poses" / "07.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 9\n" * 5)
    found = read_truth(str(folder))
    assert found is not None
    np.testing.assert_allclose(found[1][:, 2, 3], [0, 1, 2])


def test_kittis_colour_camera_has_a_path_of_its_own(tmp_path: Path) -> None:
    folder = tiny.write_kitti(tmp_path, cameras=("image_0", "image_2"))
    # K = [80 0 30; 0 50 20; 0 0 1], t = (0.06, -0.02, 0.003): camera 2 is 6 cm to the left
    calibration = "P0: 80 0 30 0 0 50 20 0 0 0 1 0\nP2: 80 0 30 4.89 0 50 20 -0.94 0 0 1 0.003\n"
    (folder / "calib.txt").write_text(calibration)
    turned = "0 0 1 5 0 1 0 6 -1 0 0 7\n"  # world_from_camera0: its x is the world's -z, its z the world's x
    (folder / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" + turned * 2)
    truth = read_truth(str(folder))
    assert truth is not None
    np.testing.assert_allclose(truth[1][0, :3, 3], [-0.06, 0.02, -0.003], atol=1e-12)
    np.testing.assert_allclose(truth[1][1, :3, 3], [5 - 0.003, 6 + 0.02, 7 + 0.06], atol=1e-12)
    np.testing.assert_array_equal(truth[1][1, :3, :3], [[0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    (folder / "calib.txt").write_text(calibration.replace("80 0 30 4.89", "0 0 30 4.89"))
    with pytest.raises(ConfigError, match=r"calib\.txt line 2"):
        read_truth(str(folder))


def test_kitti_in_a_folder_directly_below_the_root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tiny.write_kitti(tmp_path)
    monkeypatch.setattr(Path, "absolute", lambda self: Path("/seq"))
    truth = read_truth(str(folder))
    assert truth is not None
    assert len(truth[0]) == 3


@pytest.mark.parametrize("text", ["", "# timestamp tx ty tz qx qy qz qw\n"])
def test_a_file_of_truth_that_holds_none_is_named(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, text: str
) -> None:
    """As of a download that was cut short: else the file would be said to be missing."""
    tiny.write_tum(tmp_path)
    (tmp_path / "groundtruth.txt").write_text(text)
    assert read_truth(str(tmp_path)) is None
    assert f"{tmp_path / 'groundtruth.txt'} holds no pose" in caplog.text


def test_sequences_without_truth(tmp_path: Path) -> None:
    folder = tiny.write_tum(tmp_path / "tum")
    (folder / "groundtruth.txt").unlink()
    assert read_truth(str(folder)) is None
    assert read_truth(str(tiny.write_images(tmp_path / "images"))) is None
    assert read_truth(str(tiny.write_video(tmp_path / "v" / "clip.avi"))) is None


@pytest.mark.parametrize(
    "line",
    ["1.0 0 0 0 0 0 0", "1.0 0 0 0 0 0 0 a", "1.0 0 0 0 0 0 0 0", "x 0 0 0 0 0 0 1", "1 nan 0 0 0 0 0 1"],
)
def test_damaged_truth_is_named(tmp_path: Path, line: str) -> None:
    folder = tiny.write_tum(tmp_path)
    (folder / "groundtruth.txt").write_text(f"# c\n{line}\n")
    with pytest.raises(SourceError, match=r"groundtruth\.txt line 2"):
        read_truth(str(folder))


def test_poses_that_are_not_finite_are_left_out_and_counted(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folder = tiny.write_tum(tmp_path)
    table = folder / "groundtruth.txt"
    lines = table.read_text().splitlines()
    lines[2] = f"{lines[2].split()[0]} nan nan nan nan nan nan nan"
    lines[4] = lines[4].replace("0.300", "-inf")
    table.write_text("\n".join(lines))
    truth = read_truth(str(folder))
    assert truth is not None
    np.testing.assert_allclose(truth[1][:, 0, 3], [0.0, 0.2, 0.4])
    (record,) = caplog.records
    assert "groundtruth.txt line 3" in record.getMessage()
    assert "2 of 5" in record.getMessage()
    table.write_text("# c\n1 nan 0 0 0 0 0 1\n2 0 0 0 inf 0 0 1\n")
    with pytest.raises(SourceError, match="line 2: not finite"):
        read_truth(str(folder))


def test_kittis_poses_must_be_finite(tmp_path: Path) -> None:
    """They go by their place in the file: to leave one out is no choice."""
    folder = tiny.write_kitti(tmp_path)
    (folder / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 nan 0 1 0 0 0 0 1 0\n" * 2)
    with pytest.raises(SourceError, match="line 2: not finite"):
        read_truth(str(folder))


def test_damaged_poses_are_named(tmp_path: Path) -> None:
    scenes = tiny.write_seven_scenes(tmp_path / "scenes")
    (scenes / "frame-000002.pose.txt").write_text("1 0 0\n")
    with pytest.raises(SourceError, match="frame-000002"):
        read_truth(str(scenes))
    kitti = tiny.write_kitti(tmp_path / "kitti")
    (kitti / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n")
    with pytest.raises(SourceError, match="1 poses for the 3 times"):
        read_truth(str(kitti))
    (kitti / "poses.txt").write_text("2 0 0 0 0 1 0 0 0 0 1 0\n" * 3)
    with pytest.raises(SourceError, match=r"poses\.txt line 1"):
        read_truth(str(kitti))


def test_only_the_scorer_imports_the_truth() -> None:
    allowed = {"evaluation", "cli"}
    # A simulated world is drawn from where a file has the camera, as from any way: nothing estimates there.
    readers = [PACKAGE / "sources" / "truth.py", PACKAGE / "sources" / "sim" / "followed.py"]
    for path in PACKAGE.rglob("*.py"):
        names = set()
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and node.module:
                names |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
            elif isinstance(node, ast.Import):
                names |= {alias.name for alias in node.names}
        if names & {"prism_edge.sources.truth", "prism_edge.sources.tum_poses"} and path not in readers:
            assert path.relative_to(PACKAGE).parts[0] in allowed, path


def write_depth(folder: Path, stamps: list[str]) -> None:
    rows = []
    for i, stamp in enumerate(stamps):
        raw = np.full((24, 32), 5000 * (i + 1), np.uint16)
        raw[0, 0] = 0
        tiny.write_image(folder / "depth" / f"{stamp}.png", raw)
        rows.append(f"{stamp} depth/{stamp}.png")
    (folder / "depth.txt").write_text("\n".join(rows) + "\n")


def test_tum_depth_is_paired_by_time_and_in_metres(tmp_path: Path) -> None:
    folder = tiny.write_tum(tmp_path)
    write_depth(folder, ["1305031102.460000", "1305031102.180000", "1305031102.600000"])
    sensor = SensorDepth(folder)
    first, second, third = (sensor.read(i) for i in range(3))
    assert first is not None
    assert first.dtype == np.float32
    assert (first[0, 0], first[5, 5]) == (0.0, 2.0)
    assert second is None  # the nearest is 95 ms away
    assert third is None  # 84 ms
    write_depth(folder, ["1305031102.375305"])
    paired = SensorDepth(folder).read(2)
    assert paired is not None
    assert paired[5, 5] == 1.0
    assert sensor.read(99) is None


@pytest.mark.parametrize(
    ("name", "own", "apart"),
    [("redkitchen", False, True), ("redkitchen", True, True), ("flat", False, True), ("flat", True, False)],
)
def test_another_recorder_s_depth_is_taken_as_registered(
    tmp_path: Path, name: str, own: bool, apart: bool
) -> None:
    """Where its files are called as 7-Scenes' are, but its camera is none of theirs."""
    folder = tiny.write_seven_scenes(tmp_path / name, count=1)
    raw = np.where(np.arange(64) < 32, 1000, 3000).astype(np.uint16)
    assert cv2.imwrite(str(folder / "frame-000000.depth.png"), np.tile(raw, (48, 1)))
    camera = Camera(640, 480, 580.0, 580.0, 320.0, 240.0) if own else SEVEN_SCENES[1]
    sensor = SensorDepth(folder)
    seen = sensor.in_colour(0, camera)
    assert seen is not None
    assert (not np.array_equal(seen, sensor.read(0))) == apart
    smaller = sensor.in_colour(0, shrunk_camera(camera, 3))  # of images made smaller: the same depth image
    np.testing.assert_array_equal(smaller, seen)


@pytest.mark.parametrize(("width", "height"), [(480, 848), (1242, 375)])
def test_depth_is_read_whatever_shape_its_images_have(tmp_path: Path, width: int, height: int) -> None:
    """A camera on its side, say: 7-Scenes' own, stretched to such a shape, would be none."""
    folder = tiny.write_tum(tmp_path)
    write_depth(folder, ["1305031102.175304"])
    camera = Camera(width, height, 700.0, 700.0, width / 2, height / 2)
    assert not SensorDepth(folder).is_apart(camera)


def test_seven_scenes_depth(tmp_path: Path) -> None:
    folder = tiny.write_seven_scenes(tmp_path, count=2)
    raw = np.array([[1500, 0], [65535, 3000]], np.uint16)
    assert cv2.imwrite(str(folder / "frame-000001.depth.png"), raw)
    sensor = SensorDepth(folder)
    assert sensor.read(0) is None
    np.testing.assert_allclose(sensor.read(1), [[1.5, 0.0], [0.0, 3.0]])


def test_damaged_depth_is_none_and_no_depth_an_error(tmp_path: Path) -> None:
    folder = tiny.write_seven_scenes(tmp_path / "a", count=2)
    with pytest.raises(SourceError, match="no depth"):
        SensorDepth(folder)
    assert cv2.imwrite(str(folder / "frame-000000.depth.png"), np.full((9, 9), 1000, np.uint16))
    tiny.truncate(folder / "frame-000000.depth.png", 0.4)
    tiny.write_image(folder / "frame-000001.depth.png", tiny.picture(1))  # eight bits, colour
    sensor = SensorDepth(folder)
    assert sensor.read(0) is None
    assert sensor.read(1) is None
    with pytest.raises(SourceError, match="no depth"):
        SensorDepth(tiny.write_images(tmp_path / "b"))
