"""What `tools/measure_cloud.py` says of clouds whose error is known."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from prism_edge.cli.main import main as prism_edge
from prism_edge.geometry.ply import ply
from prism_edge.geometry.poses import from_rt, inverse, so3_exp, transform
from prism_edge.reconstruction.cloud import Cloud
from tests.cli.mapped_room import FRAMES, MOUNT, write_room
from tests.sources import tiny_datasets as tiny
from tests.synthetic.scene import hand_held_path
from tools.measure_cloud import main, poses_of, read_ply, reference, score

MOVED = from_rt(so3_exp(np.array([0.01, -0.02, 0.015])), np.array([0.03, -0.02, 0.02]))


def corner(step: float = 0.04) -> Cloud:
    """Three walls of two metres that meet, a point each ``step``."""
    a, b = np.meshgrid(np.arange(0, 2, step), np.arange(0, 2, step))
    a, b, none = a.ravel(), b.ravel(), np.zeros(a.size)
    points = np.vstack([np.column_stack(w) for w in ((a, b, none), (none, a, b), (a, none, b))])
    normals = np.repeat(np.eye(3)[[2, 0, 1]], a.size, axis=0)
    return Cloud(points, normals, np.zeros((len(points), 3), np.uint8))


def test_a_cloud_that_is_the_reference_has_no_error_wherever_it_begins() -> None:
    walls = corner()
    found = score(transform(inverse(MOVED), walls.points), walls, np.eye(4))
    assert found.chamfer < 0.002
    assert found.f_score(0.02)[2] > 0.99
    assert found.thickness < 0.003


def test_points_off_the_walls_count_in_precision_and_walls_that_lack_in_recall() -> None:
    walls = corner()
    off = walls.points.copy()
    off[::4] += 0.1 * walls.normals[::4]
    precision, recall, f = score(off, walls, np.eye(4)).f_score(0.05)
    assert precision == pytest.approx(0.75, abs=0.02)
    assert recall > 0.97
    assert f == pytest.approx(2 * precision * recall / (precision + recall))
    two = walls.points[: 2 * len(walls.points) // 3]
    precision, recall, _ = score(two, walls, np.eye(4)).f_score(0.02)
    assert precision > 0.99
    assert recall == pytest.approx(2 / 3, abs=0.02)


def test_thickness_is_what_a_surface_is_spread_by() -> None:
    walls, rng = corner(0.02), np.random.default_rng(0)
    spread = walls.points + 0.008 * rng.normal(size=(len(walls.points), 1)) * walls.normals
    assert score(spread, walls, np.eye(4)).thickness == pytest.approx(0.008, rel=0.3)


def test_seven_scenes_own_poses_are_those_of_the_depth_camera(tmp_path: Path) -> None:
    """A wall at 2 m, seen from one spot under 50 degrees to both sides: laid together, it is one."""
    folder = tmp_path / "7scenes" / "seq-01"
    folder.mkdir(parents=True)
    row, column = np.mgrid[0:480, 0:640]
    rays = np.stack([(column - 320.0) / 585.0, (row - 240.0) / 585.0, np.ones(row.shape)], axis=-1)
    for i, degrees in enumerate((50.0, -50.0)):
        turned = so3_exp(np.array([0.0, np.radians(degrees), 0.0]))
        ahead = (rays @ turned.T)[..., 2]
        depth = np.where(ahead > 1 / 3, 2.0 / np.maximum(ahead, 1 / 3), 0.0)
        name = folder / f"frame-{i:06d}"
        cv2.imwrite(f"{name}.depth.png", np.rint(1000.0 * depth).astype(np.uint16))
        cv2.imwrite(f"{name}.color.png", np.full((480, 640, 3), 100, np.uint8))
        np.savetxt(f"{name}.pose.txt", from_rt(turned, np.zeros(3)))
    seen = reference(folder, poses_of(folder, None), 0.02, 6.0)
    left, right = (seen.points[side, 2] for side in (seen.points[:, 0] < 0, seen.points[:, 0] > 0))
    assert np.median(left) == pytest.approx(2.0, abs=0.003)
    assert np.median(right) == pytest.approx(2.0, abs=0.003)


def test_another_recorder_s_registered_depth_goes_with_the_poses_as_they_are(tmp_path: Path) -> None:
    folder = tiny.write_seven_scenes(tmp_path / "room" / "rec", count=2)
    (folder / "camera.yaml").write_text(tiny.CAMERA_VGA)
    for i in range(2):
        cv2.imwrite(f"{folder}/frame-{i:06d}.depth.png", np.full((480, 640), 3000, np.uint16))
    assert poses_of(folder, None).poses[:, :3, 3].tolist() == [[0.0, 0.0, 0.0], [0.1, 0.0, 0.0]]


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Every fourth of its depth images is left, each keyframe's among them: there is little new between."""
    folder = write_room(tmp_path_factory.mktemp("room"))
    listing = folder / "seq" / "depth.txt"
    title, *lines = listing.read_text().splitlines()
    listing.write_text("\n".join([title, *lines[::4]]) + "\n")
    return folder


def test_a_reconstruction_from_true_depth_is_the_reference(
    room: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["reconstruct", room / "seq", "--map", room / "room.prismmap", "--model", "sensor"]
    assert prism_edge([*map(str, words), "--no-pictures", "--width=160", "--out", f"{room}/room.ply"]) == 0
    capsys.readouterr()
    assert main([str(room / "seq"), str(room / "room.ply"), "--map", str(room / "room.prismmap")]) == 0
    said = capsys.readouterr().out
    assert "scale 1.000" in said
    chamfer = float(said.split("Chamfer ")[1].split()[0])
    precision = float(said.split("precision ")[2].split("%")[0])
    assert chamfer < 8.0, "keyframes see less of the room than all images do"
    assert precision > 99.0


def test_the_reference_is_seen_by_the_camera_that_is_given(
    room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = tmp_path / "camera.yaml"
    text = (room / "seq" / "camera.yaml").read_text()
    twice = re.sub(r"^(width|height): (\d+)", lambda m: f"{m[1]}: {2 * int(m[2])}", text, flags=re.MULTILINE)
    other.write_text(twice)
    (tmp_path / "any.ply").write_bytes(ply("any", np.zeros((100, 3))))
    words = [str(room / "seq"), str(tmp_path / "any.ply"), "--map", str(room / "room.prismmap")]
    assert main([*words, "--camera", str(other)]) == 3
    assert "camera.yaml" in capsys.readouterr().err


def test_a_free_scale_is_that_of_the_keyframes(
    room: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Not the cloud's: where keyframes are is right here, so it is 1, whatever the points are."""
    first = hand_held_path(FRAMES, 30.0)[0]
    points = transform(MOUNT @ inverse(first), np.random.default_rng(0).normal(size=(500, 3)))
    (room / "any.ply").write_bytes(ply("any", points))
    arguments = [str(room / "seq"), str(room / "any.ply"), "--map", str(room / "room.prismmap")]
    assert main([*arguments, "--up-to-scale", "--voxel=0.2"]) == 0
    assert "scale 1.000" in capsys.readouterr().out
    np.testing.assert_allclose(read_ply(room / "any.ply"), points, atol=1e-5)


def test_what_can_not_be_measured_is_said_in_a_line(
    room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "no.ply").write_bytes(b"solid")
    (tmp_path / "one.ply").write_bytes(ply("one", np.zeros((1, 3))))
    (tmp_path / "far.tum").write_text("1 0 0 0 0 0 0 1\n900 0 0 0 0 0 0 1\n")
    given = str(room / "room.prismmap")
    for cloud, more, words in (
        ("no.ply", [], "no PLY file of points"),
        ("none.ply", [], "none.ply"),
        ("one.ply", ["--truth", str(tmp_path / "far.tum")], "keyframes have a true pose"),
    ):
        assert main([str(room / "seq"), str(tmp_path / cloud), "--map", given, *more]) != 0
        error = capsys.readouterr().err
        assert words in error
        assert len(error.strip().splitlines()) == 1


def test_a_recording_without_a_camera_is_measured_by_the_one_that_is_given(
    room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "any.ply").write_bytes(ply("any", np.zeros((100, 3))))
    for file in (room / "seq").iterdir():
        (tmp_path / "seq").mkdir(exist_ok=True)
        (tmp_path / "seq" / file.name).symlink_to(file)
    given = (tmp_path / "seq" / "camera.yaml").rename(tmp_path / "given.yaml")
    words = [str(tmp_path / "seq"), str(tmp_path / "any.ply"), "--map", str(room / "room.prismmap")]
    assert main([*words, "--voxel=0.2", "--camera", str(given)]) == 0
    assert "a guess" not in capsys.readouterr().err
