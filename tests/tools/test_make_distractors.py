"""Composited objects against closed forms, and a whole generated folder."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from prism_edge.config import SourceConfig
from prism_edge.geometry.cameras import Camera
from prism_edge.sources.open import open_source
from prism_edge.sources.sensor_depth import SensorDepth
from prism_edge.sources.truth import read_truth
from tests.sources import tiny_datasets as tiny
from tests.synthetic.sequence import write_sequence
from tools import make_distractors
from tools.distractors.recording import Recording, filled, interpolated
from tools.distractors.solids import BOX, ELLIPSOID, Distractor, draw, hits, surface, texture

CAMERA = Camera(160, 120, 130.0, 130.0, 79.5, 59.5)
FAR = np.full((120, 160), 4.0)
UP = np.array([0.0, -1.0, 0.0])


def thing(shape: str, half: tuple[float, float, float], path: list[tuple[float, float, float]]) -> Distractor:
    return Distractor(shape, np.array(half), 1, 0.0, 1.0, np.array(path), 0.0, UP)


def test_a_sphere_is_hit_where_the_quadratic_says():
    rng = np.random.default_rng(0)
    origin = np.array([0.3, -0.2, -2.0])
    rays = np.column_stack([rng.uniform(-0.6, 0.6, (200, 2)), np.ones(200)])
    found = hits(ELLIPSOID, np.full(3, 0.7), origin, rays)
    for ray, t in zip(rays, found, strict=True):
        roots = np.roots([ray @ ray, 2 * ray @ origin, origin @ origin - 0.49])
        assert t == (np.inf if np.iscomplex(roots).any() else pytest.approx(min(roots.real)))


@pytest.mark.parametrize("shape", [BOX, ELLIPSOID])
def test_hits_lie_on_the_surface_and_normals_look_back(shape):
    half, origin = np.array([0.4, 0.7, 0.3]), np.array([0.1, 0.2, -3.0])
    rng = np.random.default_rng(1)
    rays = np.column_stack([rng.uniform(-0.3, 0.3, (400, 2)), np.ones(400)])
    t = hits(shape, half, origin, rays)
    seen = np.isfinite(t)
    assert 0.1 < seen.mean() < 0.9
    points = origin + t[seen, None] * rays[seen]
    unit = np.abs(points / half)
    level = unit.max(axis=1) if shape == BOX else np.linalg.norm(unit, axis=1)
    np.testing.assert_allclose(level, 1.0, atol=1e-9)
    normals, place = surface(shape, half, points)
    assert np.all(np.einsum("ij,ij->i", normals, rays[seen]) < 0)
    assert np.all((place >= 0) & (place < 1))


def test_from_inside_nothing_is_hit():
    rays = np.array([[0.0, 0.0, 1.0]])
    for shape in (BOX, ELLIPSOID):
        assert hits(shape, np.ones(3), np.zeros(3), rays)[0] == np.inf


def test_it_covers_what_it_should_and_nearer_surfaces_hide_it():
    box = thing(BOX, (0.4, 0.3, 0.1), [(0.0, 0.0, 2.1), (0.0, 0.0, 2.1)])
    shown, colours = draw(CAMERA, np.eye(4), 0.5, [box], FAR, {1: texture(1, 0.5)})
    covered = np.isfinite(shown)
    # The object's own axes are turned about the vertical: its width is between its two sides' extents.
    assert 4 * 130**2 * 0.1 * 0.3 / 2.2**2 / FAR.size < covered.mean() < 0.3
    assert covered[60, 80]
    assert shown[60, 80] < 2.1
    assert colours[covered].max() > 0
    near = FAR.copy()
    near[:, :80] = 1.0
    hidden, _ = draw(CAMERA, np.eye(4), 0.5, [box], near, None)
    assert not np.isfinite(hidden[:, :80]).any()
    assert np.array_equal(hidden[:, 80:], shown[:, 80:])


def test_of_two_the_nearer_is_seen():
    front, back = (thing(ELLIPSOID, (0.3, 0.3, 0.3), [(0, 0, z), (0, 0, z)]) for z in (1.5, 2.5))
    for order in ([front, back], [back, front]):
        shown, _ = draw(CAMERA, np.eye(4), 0.0, order, FAR, None)
        assert shown[60, 80] == pytest.approx(1.2, abs=0.01)


def test_it_moves_along_its_path_and_is_gone_before_and_after():
    ball = thing(ELLIPSOID, (0.2, 0.2, 0.2), [(-0.5, 0.0, 2.0), (0.5, 0.0, 2.0)])
    middles = []
    for seconds in (0.0, 0.5, 1.0):
        shown, _ = draw(CAMERA, np.eye(4), seconds, [ball], FAR, None)
        middles.append(np.flatnonzero(np.isfinite(shown).any(axis=0)).mean())
    np.testing.assert_allclose(middles, [79.5 - 32.5, 79.5, 79.5 + 32.5], atol=1.0)
    for seconds in (-0.1, 1.1):
        assert not np.isfinite(draw(CAMERA, np.eye(4), seconds, [ball], FAR, None)[0]).any()


def test_the_rows_and_columns_looked_at_leave_nothing_out():
    """Against every pixel being looked at, for objects near, far and partly outside."""
    rng = np.random.default_rng(2)
    for _ in range(20):
        at = tuple(rng.uniform((-1.5, -1.0, 0.2), (1.5, 1.0, 3.0)))
        solid = thing(str(rng.choice([BOX, ELLIPSOID])), tuple(rng.uniform(0.1, 0.6, 3)), [at, at])
        shown, _ = draw(CAMERA, np.eye(4), 0.5, [solid], FAR, None)
        x, y = np.meshgrid((np.arange(160) - CAMERA.cx) / CAMERA.fx, (np.arange(120) - CAMERA.cy) / CAMERA.fy)
        rays = np.stack([x.ravel(), y.ravel(), np.ones(x.size)], axis=1)
        rotation = solid.world_from_object(0.5)[:3, :3]
        z = hits(solid.shape, solid.half_extents, -rotation.T @ np.array(at), rays @ rotation)
        assert np.array_equal(np.isfinite(shown).ravel(), (z < 4.0) & (z > 0.05))


def test_pixels_without_depth_take_the_nearest_ones():
    depth = np.array([[0.0, 0.0, 2.0], [1.0, 0.0, 0.0]])
    made = filled(depth)
    assert (made[0, 1], made[0, 2], made[1, 0], made[1, 1]) == (2.0, 2.0, 1.0, 1.0)
    assert np.isinf(filled(np.zeros((2, 2)))).all()


def test_poses_between_known_ones_lie_on_the_way():
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, 0, 3] = 2.0
    made = interpolated(np.array([0.0, 1.0]), poses, np.array([-1.0, 0.25, 3.0]))
    np.testing.assert_allclose(made[:, 0, 3], [0.0, 0.5, 2.0])


@pytest.fixture(scope="module")
def sequence(tmp_path_factory) -> Path:
    """Two seconds of a generated room; its 20th image is an exact copy of the 19th."""
    folder = write_sequence(tmp_path_factory.mktemp("static"), 60, 160, 120)
    files = sorted((folder / "rgb").iterdir())
    files[20].write_bytes(files[19].read_bytes())
    return folder


def test_a_folder_of_the_same_layout_comes_out_twice_alike(sequence: Path, tmp_path: Path, capsys):
    for name in ("one", "two"):
        words = [str(sequence), str(tmp_path / name), "--seed", "3", "--coverage", "0.2"]
        assert make_distractors.main(words) == 0
    assert "cover" in capsys.readouterr().out
    one, two = (
        {p.relative_to(folder): p.read_bytes() for p in folder.rglob("*") if p.is_file()}
        for folder in (tmp_path / "one", tmp_path / "two")
    )
    assert one == two
    with open_source(SourceConfig(uri=str(tmp_path / "one"))) as made, open_source(
        SourceConfig(uri=str(sequence))
    ) as static:
        assert made.camera == static.camera
        assert made.frame_count == static.frame_count == 60
        images = [(made.read().pixels, static.read().pixels) for _ in range(60)]
    assert np.array_equal(images[19][0], images[20][0]), "a copy stays a copy"
    assert np.array_equal(read_truth(str(tmp_path / "one"))[1], read_truth(str(sequence))[1])
    shares = json.loads((tmp_path / "one" / "distractors.json").read_text())["covered"]
    assert 0.08 < np.mean(shares) < 0.3
    assert max(shares) < 0.5
    before, after = SensorDepth(sequence), SensorDepth(tmp_path / "one")
    for i in (0, 30, 59):
        mask = cv2.imread(str(tmp_path / "one" / "masks" / f"{i:06d}.png"), 0) > 0
        assert mask.mean() == pytest.approx(shares[i], abs=1e-3)
        changed = np.abs(images[i][0].astype(int) - images[i][1].astype(int)).max(axis=2) > 0
        rim = cv2.dilate(mask.astype(np.uint8), np.ones((3, 3))) > 0
        assert not changed[~rim].any(), "the rest of the image is as it was"
        old, new = before.read(i), after.read(i)
        assert np.array_equal(old[~mask], new[~mask])
        assert np.all(new[mask] < old[mask])


@pytest.mark.parametrize("lost", ["rgb", "masks", "depth"])
def test_an_image_that_can_not_be_written_ends_it_before_it_counts_as_made(
    sequence: Path, tmp_path: Path, capsys, monkeypatch, lost: str
):
    """In place of a full disk: a folder where the tenth image of a kind is to go."""
    planned = make_distractors.plan

    def blocked(recording, seed, coverage):
        file = sorted((sequence / lost).iterdir())[10].name if lost != "masks" else "000010.png"
        (tmp_path / "out" / lost / file).mkdir(parents=True)
        return planned(recording, seed, coverage)

    monkeypatch.setattr(make_distractors, "plan", blocked)
    assert make_distractors.main([str(sequence), str(tmp_path / "out"), "--coverage", "0.2"]) == 2
    error = capsys.readouterr().err
    assert error.startswith("make_distractors: error: ")
    assert f"/{lost}/" in error
    assert not (tmp_path / "out" / "distractors.json").exists()


@pytest.mark.parametrize(
    ("more", "says"),
    [
        (["--coverage", "0.9"], "coverage"),
        (["--contrast", "-1"], "contrast"),
        (["--poses", "missing.tum"], "missing.tum"),
    ],
)
def test_bad_arguments_end_in_one_line(sequence: Path, tmp_path: Path, capsys, more, says):
    assert make_distractors.main([str(sequence), str(tmp_path / "out"), *more]) == 2
    error = capsys.readouterr().err
    assert says in error
    assert error.count("\n") == 1


def test_poses_of_another_time_or_a_single_one_are_no_path(sequence: Path, tmp_path: Path, capsys):
    for stamps in (("1000.0", "1002.0"), ("0.0",)):
        (tmp_path / "way.tum").write_text("".join(f"{stamp} 0 0 0 0 0 0 1\n" for stamp in stamps))
        words = [str(sequence), str(tmp_path / "out"), "--poses", str(tmp_path / "way.tum")]
        assert make_distractors.main(words) == 2
        error = capsys.readouterr().err
        assert "way.tum: its poses are of other times" in error
        assert error.count("\n") == 1


def beside(sequence: Path, folder: Path, name: str) -> Path:
    """A recording whose tables lie in one folder and images in another, which they reach by ``name``."""
    shutil.copytree(sequence, folder / "images")
    (folder / "tables").mkdir()
    for table in ("rgb.txt", "depth.txt", "groundtruth.txt", "camera.yaml"):
        (folder / "images" / table).rename(folder / "tables" / table)
    for table in ("rgb.txt", "depth.txt"):
        lines = (folder / "tables" / table).read_text().splitlines()
        named = [line if line.startswith("#") else line.replace(" ", f" {name}/", 1) for line in lines]
        (folder / "tables" / table).write_text("\n".join(named) + "\n")
    return folder / "tables"


def test_a_way_through_another_folder_leads_into_this_one(sequence: Path):
    file = sequence / "rgb/../rgb/x.png"
    assert Recording(sequence, None).inside(file) == Path("rgb/x.png")


@pytest.mark.parametrize("by", ["parent", "absolute"])
def test_images_of_another_folder_are_refused_and_not_written_over(
    by: str, sequence: Path, tmp_path: Path, capsys
):
    name = {"parent": "../images", "absolute": str(tmp_path / "images")}[by]
    folder = beside(sequence, tmp_path, name)
    before = {path: path.read_bytes() for path in (tmp_path / "images").rglob("*") if path.is_file()}
    assert make_distractors.main([str(folder), str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "is not in" in error
    assert not (tmp_path / "out").exists()
    assert {path: path.read_bytes() for path in (tmp_path / "images").rglob("*") if path.is_file()} == before


def test_absolute_names_within_the_folder_are_refused_too(sequence: Path, tmp_path: Path, capsys):
    """The copied table would play the originals."""
    folder = shutil.copytree(sequence, tmp_path / "seq")
    text = (folder / "rgb.txt").read_text()
    (folder / "rgb.txt").write_text(text.replace(" rgb/", f" {folder}/rgb/"))
    assert make_distractors.main([str(folder), str(tmp_path / "out")]) == 2
    assert "rgb.txt line" in capsys.readouterr().err


@pytest.mark.parametrize("how", ["missing", "damaged", "8 bits"])
def test_a_depth_image_that_is_none_is_left_out(how: str, sequence: Path, tmp_path: Path, capsys):
    folder = shutil.copytree(sequence, tmp_path / "seq")
    file = sorted((folder / "depth").iterdir())[19]  # its colour image has a copy
    if how == "8 bits":
        assert cv2.imwrite(str(file), np.full((120, 160), 200, np.uint8))
    else:
        file.unlink() if how == "missing" else file.write_bytes(b"no image")
    assert make_distractors.main([str(folder), str(tmp_path / "out"), "--coverage", "0.2"]) == 0
    assert f"{file} is no depth image: left out" in capsys.readouterr().err
    assert not (tmp_path / "out" / "depth" / file.name).exists()
    with open_source(SourceConfig(uri=str(tmp_path / "out"))) as made:
        assert made.frame_count == 60


def test_a_folder_without_depth_and_one_that_is_taken_are_refused(sequence: Path, tmp_path: Path, capsys):
    plain = tmp_path / "plain"
    plain.mkdir()
    for name in ("rgb", "rgb.txt", "groundtruth.txt", "camera.yaml"):
        (plain / name).symlink_to(sequence / name)
    assert make_distractors.main([str(plain), str(tmp_path / "out")]) == 2
    assert "no depth" in capsys.readouterr().err
    assert make_distractors.main([str(sequence), str(plain)]) == 2
    assert "not empty" in capsys.readouterr().err


def test_bonns_truth_is_carried_over_once(sequence: Path, tmp_path: Path):
    """Its folder's name says that the markers' poses lie there; the name of what is made doesn't."""
    folder, out = tmp_path / "rgbd_bonn_room", tmp_path / "out"
    folder.symlink_to(sequence)
    out.mkdir()
    make_distractors.copy_rest(Recording(folder, None), out)
    (stamps, poses), before = read_truth(str(out)), read_truth(str(folder))
    assert stamps.tolist() == before[0].tolist()
    assert poses == pytest.approx(before[1], abs=1e-8)


def test_a_scene_s_folder_keeps_the_truth_of_the_sequence_in_it(tmp_path: Path, capfd):
    scene, out = tmp_path / "7scenes_office", tmp_path / "out"
    tiny.write_seven_scenes(scene / "seq-01", count=2)
    for i in range(2):
        depth = np.full((480, 640), 3000, np.uint16)
        assert cv2.imwrite(str(scene / "seq-01" / f"frame-{i:06d}.depth.png"), depth)
    recording = Recording(scene, None)
    make_distractors.write(recording, [], 1.0, out)
    make_distractors.copy_rest(recording, out)
    before, after = (read_truth(str(folder)) for folder in (scene, out))
    np.testing.assert_array_equal(before[1], after[1])
    assert capfd.readouterr().err == "", "OpenCV complains of options that a format doesn't have"


def test_replaced_extents_are_the_only_change_of_size():
    """Planning scales an object and nothing else of it."""
    ball = thing(ELLIPSOID, (0.2, 0.2, 0.2), [(0.0, 0.0, 2.0), (0.0, 0.0, 2.0)])
    bigger = replace(ball, half_extents=ball.half_extents * 1.5)
    small, large = (draw(CAMERA, np.eye(4), 0.5, [b], FAR, None)[0] for b in (ball, bigger))
    assert np.isfinite(large).mean() == pytest.approx(1.5**2 * np.isfinite(small).mean(), rel=0.15)


@pytest.fixture
def apart(tmp_path: Path) -> Recording:
    """A 7-Scenes folder: a wall at 3 m, before it at 1 m a board of 100 x 80 pixels of the depth camera."""
    folder = tiny.write_seven_scenes(tmp_path / "apart", count=2)
    raw = np.full((480, 640), 3000, np.uint16)
    raw[200:280, 300:400] = 1000
    raw[:20, :20] = 65535  # nothing came back
    for i in range(2):
        assert cv2.imwrite(str(folder / f"frame-{i:06d}.depth.png"), raw)
    return Recording(folder, None)


def test_depth_that_is_not_registered_is_where_the_colour_camera_sees_it(apart: Recording):
    """By hand: 25 mm to the right, and the focal lengths' ratio."""
    depth, c = apart.depth(0), apart.camera
    row, column = np.nonzero(depth == 1.0)
    left, right, wall = (z * (x - 320) / 585.0 - 0.025 for x, z in ((300, 1.0), (399, 1.0), (400, 3.0)))
    assert column.min() == pytest.approx(c.fx * left + c.cx, abs=1)
    # Between the board and what the sensor has of the wall is the board's shadow, half of it filled from it.
    assert column.max() == pytest.approx(c.fx * (right + wall / 3) / 2 + c.cx, abs=1.5)
    top, bottom = ((y - 240) / 585.0 - 0.005 for y in (200, 279))
    assert row.min() == pytest.approx(c.fy * top + c.cy, abs=1)
    assert row.max() == pytest.approx(c.fy * bottom + c.cy, abs=1)
    assert np.isclose(depth[60:400, 60:250], 3.0).all()
    assert np.array_equal(apart.depth(0, 8), depth[::8, ::8])


def test_depth_that_another_recorder_registered_is_where_the_colour_camera_has_it(tmp_path: Path):
    """Files named as 7-Scenes' are, of a camera that isn't theirs: both ways pixel for pixel."""
    folder = tiny.write_seven_scenes(tmp_path / "room" / "rec", count=2)
    (folder / "camera.yaml").write_text(tiny.CAMERA_VGA)
    raw = np.full((480, 640), 3000, np.uint16)
    raw[200:280, 300:400] = 1000
    for i in range(2):
        assert cv2.imwrite(str(folder / f"frame-{i:06d}.depth.png"), raw)
    recording = Recording(folder, None)
    assert np.array_equal(recording.depth(0), raw / 1000.0)
    shown = np.where(raw == 1000, 0.5, np.inf)
    assert np.array_equal(recording.in_sensor(shown, raw.shape), shown)


def test_a_repeated_frame_shares_the_depth_of_the_first(tmp_path: Path):
    """Colour comes faster than depth, and the recorder repeats frames: one depth image for both."""
    folder = tiny.write_tum(tmp_path / "tum", count=4)
    rows = (folder / "rgb.txt").read_text().splitlines()
    (at, first), (_, second), *others = (row.split() for row in rows if not row.startswith("#"))
    shutil.copyfile(folder / first, folder / second)
    stamps = [(at, first), (f"{float(at) + 0.016:.6f}", second), *others]
    (folder / "rgb.txt").write_text("".join(f"{stamp} {name}\n" for stamp, name in stamps))
    (folder / "depth").mkdir(exist_ok=True)
    assert cv2.imwrite(str(folder / "depth" / "one.png"), np.full((48, 64), 15000, np.uint16))
    (folder / "depth.txt").write_text(f"{float(at) + 0.008:.6f} depth/one.png\n")
    recording, out = Recording(folder, None), tmp_path / "out"
    assert recording.sensor_file(0) == recording.sensor_file(1) is not None
    make_distractors.write(recording, [], 1.0, out)
    assert (out / "depth" / "one.png").is_file()


def test_an_object_is_in_the_sensors_image_where_the_sensor_sees_it(apart: Recording, tmp_path: Path):
    shown = np.full((480, 640), np.inf)
    shown[150:300, 250:330] = 2.0  # partly where the sensor sees the board
    shown[:, 290:] = np.where(apart.depth(0)[:, 290:] < 2.0, np.inf, shown[:, 290:])
    file = apart.sensor_file(0)
    make_distractors._write_depth(apart, file, shown, tmp_path / "made")
    raw = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
    made = cv2.imread(str(tmp_path / "made" / file.name), cv2.IMREAD_UNCHANGED)
    assert set(np.unique(made[made != raw])) == {2000}
    row, column = np.nonzero(made != raw)
    assert column.min() == pytest.approx(585 * ((250 - 320) / 525.0 + 0.025 / 2) + 320, abs=1)
    assert row.max() == pytest.approx(585 * ((299 - 240) / 525.0 + 0.005 / 2) + 240, abs=1)
    assert np.array_equal(made[200:280, 300:400], raw[200:280, 300:400]), "the board is nearer"
    shutil.copyfile(tmp_path / "made" / file.name, file)
    again, mask = apart.depth(0), np.isfinite(shown)
    inner = cv2.erode(mask.astype(np.uint8), np.ones((5, 5))) > 0
    outer = cv2.dilate(mask.astype(np.uint8), np.ones((5, 5))) > 0
    assert (again[inner] == 2.0).mean() > 0.95
    assert not (again[~outer] == 2.0).any()
