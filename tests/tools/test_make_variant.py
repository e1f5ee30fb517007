"""Recordings played otherwise: the points that are seen must be where camera and poses put them."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from prism_edge.config import SourceConfig
from prism_edge.errors import SourceError
from prism_edge.evaluation.trajectory import read_tum
from prism_edge.geometry.cameras import Camera
from prism_edge.geometry.poses import from_rt, inverse, so3_exp, transform
from prism_edge.sources import open_source
from prism_edge.sources.camera_file import read_camera
from prism_edge.sources.truth import read_truth
from tests.sources import tiny_datasets as tiny
from tests.synthetic.sequence import write_sequence
from tools import make_variant
from tools.make_kidnapping import describe
from tools.make_variant import MIRROR, Variant, write


def played(folder: Path, camera: bool = True) -> tuple[list[np.ndarray], list[int], Camera]:
    config = SourceConfig(uri=str(folder), camera=str(folder / "camera.yaml") if camera else "")
    with open_source(config) as source:
        images = []
        while (image := source.read()) is not None:
            images.append(image)
        return [i.pixels for i in images], [i.stamp_ns for i in images], source.camera


@pytest.mark.parametrize("backwards", [False, True])
@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("every", [1, 2])
def test_images_and_poses_stay_together(tmp_path, backwards, mirrored, every):
    source, out = write_sequence(tmp_path / "in", frames=7, width=160, height=120), tmp_path / "out"
    truth = source / "groundtruth.txt"
    assert write(str(source), out, Variant(backwards, mirrored, every), truth) == len(range(0, 7, every))
    before, stamps, camera = played(source, camera=False)
    now, new_stamps, new_camera = played(out)
    _, poses = read_truth(str(source))
    _, new_poses = read_truth(str(out))
    kept = list(range(0, 7, every))[:: -1 if backwards else 1]
    flip = MIRROR if mirrored else np.eye(4)
    for image, pose, i in zip(now, new_poses, kept, strict=True):
        assert np.array_equal(image, before[i][:, ::-1] if mirrored else before[i])
        assert pose == pytest.approx(flip @ poses[i] @ flip, abs=1e-6)
    assert (new_stamps[0], new_stamps[-1]) == (stamps[0], stamps[kept[0] if backwards else kept[-1]])
    assert np.diff(new_stamps) == pytest.approx(np.abs(np.diff(np.array(stamps)[kept])), abs=2)
    assert new_camera.cx == (pytest.approx(159 - camera.cx) if mirrored else camera.cx)
    assert read_tum(out / "reference.tum").poses == pytest.approx(new_poses, abs=1e-6)


def test_images_whose_stamps_go_back_are_left_out(tmp_path):
    """As the daemon would: of a table that is listed backwards in time there is one image."""
    folder = tiny.write_tum(tmp_path / "seq")
    lines = [line for line in (folder / "rgb.txt").read_text().splitlines() if not line.startswith("#")]
    (folder / "rgb.txt").write_text("\n".join([*lines[2:], *lines[:2], lines[-1]]) + "\n")
    assert write(str(folder), tmp_path / "out", Variant(ways=2)) == 2 * (len(lines) - 2) - 1


def test_a_camera_may_be_given(tmp_path):
    folder = tmp_path / "images"
    folder.mkdir()
    for i in range(3):
        assert cv2.imwrite(str(folder / f"{i}.png"), tiny.picture(i))
    camera = tmp_path / "camera.yaml"
    camera.write_text(tiny.CAMERA)
    assert write(str(folder), tmp_path / "out", Variant(), camera=str(camera)) == 3
    with open_source(SourceConfig(uri=str(tmp_path / "out"))) as made:
        assert made.camera.fx == 60.0


@pytest.mark.parametrize("backwards", [False, True])
def test_there_and_back_turns_at_the_ends(tmp_path, backwards):
    source, out = write_sequence(tmp_path / "in", frames=4, width=160, height=120), tmp_path / "out"
    variant = Variant(backwards, ways=3)
    assert write(str(source), out, variant, source / "groundtruth.txt") == 10
    before, stamps, _ = played(source, camera=False)
    now, new_stamps, _ = played(out)
    order = [0, 1, 2, 3, 2, 1, 0, 1, 2, 3]
    order = [3 - i for i in order] if backwards else order
    _, poses = read_truth(str(source))
    _, new_poses = read_truth(str(out))
    for image, pose, i in zip(now, new_poses, order, strict=True):
        assert np.array_equal(image, before[i])
        assert pose == pytest.approx(poses[i], abs=1e-6)
    assert np.diff(new_stamps) == pytest.approx(np.full(9, stamps[1] - stamps[0]), abs=2000)  # microseconds
    assert len(read_tum(out / "reference.tum").poses) == 10


@pytest.mark.parametrize(
    ("variant", "order"),
    [
        (Variant(), 1.0),
        (Variant(mirrored=True), 1.0),
        (Variant(backwards=True), -1.0),
        (Variant(ways=2), 0.0),
    ],
)
def test_rows_are_read_in_the_order_of_time(tmp_path, variant, order):
    taken = Camera(64, 48, 60.0, 60.0, 30.0, 23.0, readout_ms=26.0)
    describe(variant.camera(taken), tmp_path / "camera.yaml")
    assert read_camera(tmp_path / "camera.yaml").readout_ms == 26.0 * order
    describe(variant.camera(replace(taken, readout_ms=None)), tmp_path / "camera.yaml")
    assert read_camera(tmp_path / "camera.yaml").readout_ms == (None if order else 0.0)


def test_a_mirrored_camera_sees_a_mirrored_world():
    camera = Camera(320, 240, 260.0, 250.0, 161.0, 118.0)
    pose = from_rt(so3_exp(np.array([0.1, -0.3, 0.2])), np.array([0.4, -0.1, 0.3]))
    points = np.array([[0.2, -0.4, 3.0], [-0.5, 0.3, 2.5]])
    variant = Variant(mirrored=True)
    seen = camera.project(transform(inverse(pose), points))
    mirrored = variant.camera(camera).project(
        transform(inverse(variant.pose(pose)), points * (-1.0, 1.0, 1.0))
    )
    assert mirrored[:, 0] == pytest.approx(319.0 - seen[:, 0])
    assert mirrored[:, 1] == pytest.approx(seen[:, 1])
    assert np.linalg.det(variant.pose(pose)[:3, :3]) == pytest.approx(1.0)


def test_stamps_near_todays_epoch_are_kept_to_the_nanosecond(tmp_path):
    source = write_sequence(tmp_path / "in", frames=4, width=160, height=120)
    epoch = 1_305_031_102
    for name in ("rgb.txt", "groundtruth.txt"):
        rows = [line.split(" ", 1) for line in (source / name).read_text().splitlines() if line[0] != "#"]
        later = "".join(f"{epoch + i}.{175304000 + 7 * i:09d} {rest}\n" for i, (_, rest) in enumerate(rows))
        (source / name).write_text(later)
    write(str(source), tmp_path / "out", Variant(every=3))
    _, stamps, _ = played(tmp_path / "out")
    assert stamps == [epoch * 10**9 + 175304000, (epoch + 3) * 10**9 + 175304021]
    assert read_truth(str(tmp_path / "out"))[0].tolist() == stamps


def test_no_recording_is_made_under_a_name_of_bonns(tmp_path):
    """Its true poses are the camera's, and would be taken for the markers'."""
    source, out = write_sequence(tmp_path / "in", frames=2, width=160, height=120), tmp_path / "rgbd_bonn_b"
    with pytest.raises(SourceError, match="another folder"):
        write(str(source), out, Variant(backwards=True))
    assert not out.exists()


def test_poses_of_images_left_out_are_left_out(tmp_path):
    source = write_sequence(tmp_path / "in", frames=7, width=160, height=120)
    write(str(source), tmp_path / "out", Variant(every=3))
    assert len(read_truth(str(tmp_path / "out"))[0]) == 3


def test_in_little_light_images_are_darker_and_noisier(tmp_path):
    source = write_sequence(tmp_path / "in", frames=3, width=160, height=120)
    write(str(source), tmp_path / "out", Variant(light=0.1))
    before, _, _ = played(source, camera=False)
    now, _, _ = played(tmp_path / "out")
    for bright, dark in zip(before, now, strict=True):
        expected = 0.1 * bright.astype(float)
        assert dark.mean() == pytest.approx(expected.mean(), rel=0.02)
        assert np.mean((dark - expected) ** 2) == pytest.approx(expected.mean(), rel=0.05), "Poisson's"


@pytest.mark.parametrize("mirrored", [False, True])
def test_a_narrower_camera_sees_the_same_in_its_middle(tmp_path, mirrored):
    source = write_sequence(tmp_path / "in", frames=2, width=163, height=120)
    before, _, taken = played(source, camera=False)
    variant = Variant(middle=0.6, mirrored=mirrored)
    write(str(source), tmp_path / "out", variant)
    now, _, camera = played(tmp_path / "out")
    assert (camera.width, camera.height) == now[0].shape[1::-1] == (98, 72)
    point = np.array([[0.02, -0.03, 1.0]])
    u, v = np.rint(taken.project(point)[0]).astype(int)
    seen = camera.project(point * ((-1.0 if mirrored else 1.0), 1.0, 1.0))[0]
    assert np.array_equal(now[0][round(seen[1]), round(seen[0])], before[0][v, u])
    assert np.array_equal(now[0][:, ::-1] if mirrored else now[0], before[0][24:96, 32:130])
    told = replace(taken, readout_ms=20.0)
    assert replace(variant, backwards=True).camera(told).readout_ms == pytest.approx(-12.0)


def test_a_piece_keeps_its_stamps_and_poses(tmp_path):
    source = write_sequence(tmp_path / "in", frames=9, width=160, height=120)
    before, stamps, _ = played(source, camera=False)
    assert write(str(source), tmp_path / "out", Variant(every=2, first=1, count=5)) == 3
    now, new_stamps, _ = played(tmp_path / "out")
    assert all(np.array_equal(image, before[i]) for image, i in zip(now, (1, 3, 5), strict=True))
    assert new_stamps == [stamps[i] for i in (1, 3, 5)]
    assert read_truth(str(tmp_path / "out"))[1] == pytest.approx(
        np.array(read_truth(str(source))[1])[[1, 3, 5]], abs=1e-6
    )


def test_a_bonnet_is_the_same_in_every_image_and_hides_no_more_than_a_fifth(tmp_path):
    source = write_sequence(tmp_path / "in", frames=3, width=160, height=120)
    write(str(source), tmp_path / "out", Variant(bonnet=True))
    before, _, _ = played(source, camera=False)
    now, _, _ = played(tmp_path / "out")
    assert all(np.array_equal(image[-24:], now[0][-24:]) for image in now)
    assert now[0][-24:].std() > 40.0
    assert all(np.array_equal(a[:-24], b[:-24]) for a, b in zip(now, before, strict=True))


@pytest.mark.parametrize(
    ("argument", "says"),
    [
        ("--every=0", "1 or more"),
        ("--ways=0", "1 or more"),
        ("--light=0", "--light"),
        ("--middle=0", "--middle"),
        ("--middle=1.1", "--middle"),
        ("--first=-1", "--first"),
        ("--count=-1", "--count"),
        ("--first=2", "no image"),
        ("nothing", "nothing"),
    ],
)
def test_what_makes_no_sense_is_one_line(tmp_path, monkeypatch, argument, says):
    source = write_sequence(tmp_path / "in", frames=2, width=160, height=120)
    folder = [str(source)] if argument.startswith("--") else [str(tmp_path / argument)]
    flags = [argument] if argument.startswith("--") else []
    monkeypatch.setattr(sys, "argv", ["make_variant.py", *folder, str(tmp_path / "out"), *flags])
    with pytest.raises(SystemExit, match=says) as ended:
        make_variant.main()
    assert "\n" not in str(ended.value)


def test_a_place_that_takes_no_folder_is_one_line(tmp_path, monkeypatch):
    source = write_sequence(tmp_path / "in", frames=2, width=160, height=120)
    (tmp_path / "file").touch()
    monkeypatch.setattr(sys, "argv", ["make_variant.py", str(source), str(tmp_path / "file" / "out")])
    with pytest.raises(SystemExit, match="file") as ended:
        make_variant.main()
    assert "\n" not in str(ended.value)


def test_a_folder_that_holds_something_is_refused_and_left_as_it_is(tmp_path):
    """Images of an earlier, longer recording would be played as well."""
    source, out = write_sequence(tmp_path / "in", frames=9, width=160, height=120), tmp_path / "out"
    write(str(source), out, Variant())
    before = sorted(out.rglob("*"))
    with pytest.raises(SourceError, match="not empty"):
        write(str(source), out, Variant())
    assert sorted(out.rglob("*")) == before
