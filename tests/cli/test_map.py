"""`prism-edge map` on saved maps: what it prints and writes, against the poses that were published."""

from __future__ import annotations

import os
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from prism_edge.backend import map_file
from prism_edge.backend.map_facts import STAMPS
from prism_edge.backend.map_mount import FIELD as MOUNT
from prism_edge.bus import ros
from prism_edge.cli.main import main
from prism_edge.config import FramesConfig, StateConfig
from prism_edge.evaluation.trajectory import read_tum
from prism_edge.geometry.mount import base_from_camera
from prism_edge.geometry.poses import inverse
from prism_edge.messages import OK
from prism_edge.tracking.odometry import MetricOdometry
from prism_edge.tracking.tracker import FrameResult
from prism_edge.workers.backend import BackendWorker
from prism_edge.workers.pose_publisher import PosePublisher
from tests.backend.world import Teller
from tests.synthetic.messages import scale_of
from tests.tracking.cloud import pose_at
from tests.tracking.footage import footage
from tests.workers.list_bus import ListBus
from tests.workers.tracker_bench import CONFIG, World, depth_of, frame, run

# Tilted and aside: no two of its axes can be mistaken for one another.
FRAMES = FramesConfig(
    base_from_camera_xyz=(0.3, -0.1, 0.5),
    base_from_camera_xyzw=(-0.7303984, 0.4216957, -0.2686498, 0.4653151),
)
SEAT = base_from_camera(FRAMES)
LOG_SCALE = 0.3  # a map unit is 1.35 m


@pytest.fixture(scope="module")
def state(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, ListBus]:
    """A state directory with the map `lab` that tracker and backend made of the film, and all that was sent.

    The first depth, which gives the map its unit, is too small by a factor, which `log_scale` then says.
    """
    folder = tmp_path_factory.mktemp("state")
    kept = StateConfig(directory=str(folder), journal=False)
    config, bus, beside = replace(CONFIG, frames=FRAMES, state=kept), ListBus("frame"), ListBus("keyframe")
    world = World(bus)

    def small_at_first(image: Any) -> Any:
        depth = depth_of(image)
        return depth if image.keyframe else replace(depth, depth=depth.depth * np.float32(np.exp(-LOG_SCALE)))

    world.depth, world.scale = small_at_first, lambda keyframe: scale_of(keyframe, LOG_SCALE)
    run(bus, [frame(i) for i in range(60)], config)
    made = BackendWorker(config, beside)
    for keyframe in bus.of("keyframe"):
        made._absorb(keyframe)
        beside.give("log_scale", scale_of(keyframe, LOG_SCALE, bias_sigma=0.12, network="film@012345"))
    made._realtime()
    assert made._save_map("lab").ok
    return folder, bus


def lab(state: tuple[Path, ListBus]) -> Path:
    return state[0] / "maps" / "lab.prismmap"


def call(*words: object) -> int:
    return main(["map", *map(str, words)])


def changed(state: tuple[Path, ListBus], folder: Path, **info: object) -> Path:
    """The map with other plain values, or without those that are None."""
    known, arrays = map_file.unpack(lab(state).read_bytes())
    known = {name: value for name, value in {**known, **info}.items() if value is not None}
    path = folder / "changed.prismmap"
    path.write_bytes(map_file.pack(known, arrays))
    return path


def points_of(path: Path) -> np.ndarray:
    """The vertices (m, 3) of a PLY file."""
    header, _, body = path.read_bytes().partition(b"end_header\n")
    count = int(re.search(rb"element vertex (\d+)\n", header)[1])  # type: ignore[index]
    assert len(body) == 12 * count
    return np.frombuffer(body, "<f4").reshape(count, 3)


class TestExport:
    def test_poses_are_those_that_were_published_and_the_true_ones(
        self, state: tuple[Path, ListBus], tmp_path: Path
    ) -> None:
        film, bus = footage(), state[1]
        here = ("--set", f"state.directory={state[0]}")
        cameras, bases = tmp_path / "cameras.tum", tmp_path / "bases.tum"
        assert call("export", "lab", "--tum", cameras, *here) == 0
        assert call("export", "lab", "--tum", bases, "--of", "base", *here) == 0
        published = {ros.stamp_ns(m): ros.pose_matrix(m.pose.pose) for m in bus.of("pose")}
        true = {film.stamp_ns(i): SEAT @ pose for i, pose in enumerate(film.poses)}
        keyframes = {k.stamp_ns for k in bus.of("keyframe")}
        found, of_base = read_tum(cameras), read_tum(bases)
        assert set(found.stamps.tolist()) == set(of_base.stamps.tolist()) == keyframes
        assert len(keyframes) >= 4
        way = np.linalg.norm(true[max(keyframes)][:3, 3] - SEAT[:3, 3])
        assert way * (1.0 - np.exp(-LOG_SCALE)) > 0.1, "what is not in metres would be seen"
        for stamp, camera, base in zip(found.stamps.tolist(), found.poses, of_base.poses, strict=True):
            off = np.abs(camera - true[stamp])
            assert off[:3, 3].max() < 0.05
            assert off[:3, :3].max() < 0.02
            np.testing.assert_allclose(base, camera @ inverse(SEAT), atol=1e-8)
        told = [k.stamp_ns for k in bus.of("keyframe")[2:]]  # by then the scale was known
        for stamp, base in zip(of_base.stamps.tolist(), of_base.poses, strict=True):
            if stamp in told:
                np.testing.assert_allclose(base, published[stamp], atol=0.05)

    def test_poses_are_what_the_publisher_makes_of_them_to_the_last_digits(
        self, state: tuple[Path, ListBus], tmp_path: Path
    ) -> None:
        info, arrays = map_file.unpack(lab(state).read_bytes())
        out, sent = tmp_path / "bases.tum", ListBus("frame")
        assert call("export", lab(state), "--tum", out, "--of", "base") == 0
        publisher, nothing = PosePublisher(sent, FRAMES), np.zeros(3)  # type: ignore[arg-type]
        for stamp, pose in zip(info[STAMPS], arrays["poses"], strict=True):
            result = FrameResult(OK, pose, np.eye(6), 0, np.eye(4), 100)
            scale = info["log_scale"], 0.1
            publisher.publish(stamp, result, MetricOdometry(), *scale, nothing, mount_of_map=SEAT)
        for message, pose in zip(sent.of("pose"), read_tum(out).poses, strict=True):
            np.testing.assert_allclose(ros.pose_matrix(message.pose.pose), pose, atol=1e-7)

    def test_points_lie_on_what_the_camera_saw(self, state: tuple[Path, ListBus], tmp_path: Path) -> None:
        out = tmp_path / "points.ply"
        assert call("export", lab(state), "--ply", out) == 0
        points = points_of(out)
        assert len(points) > 300
        film = footage()
        seen = inverse(SEAT)[:3] @ np.vstack([points.T.astype(np.float64), np.ones(len(points))])
        pixels = film.camera.project(seen.T)
        inside = (seen[2] > 0.1) & (np.abs(pixels - (160, 120)) < (159, 119)).all(axis=1)
        columns, rows = np.rint(pixels[inside]).astype(int).T
        off = np.abs(seen[2][inside] / film.depths[0][rows, columns] - 1.0)
        assert inside.sum() > 200
        assert np.median(off) < 0.02
        n = len(map_file.unpack(lab(state).read_bytes())[1]["keyframes"])
        assert f"comment points of a prism_edge map of {n} keyframes".encode() in out.read_bytes()

    def test_both_at_once_and_never_over_what_is_there_unasked(
        self, state: tuple[Path, ListBus], tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        tum, points = tmp_path / "a.tum", tmp_path / "a.ply"
        both = ("export", lab(state), "--tum", tum, "--ply", points)
        assert call(*both) == 0
        said = capsys.readouterr()
        assert said.err == ""
        assert re.fullmatch(
            rf"{tum}: \d+ keyframe poses of the camera, metres in map\n{points}: \d+ points, metres in map\n",
            said.out,
        )
        good = tum.read_bytes(), points.read_bytes()
        tum.unlink()
        points.write_bytes(b"mine")
        assert call(*both) == 3
        assert capsys.readouterr().err.endswith("is there already: name another, or give --overwrite\n")
        assert (tum.exists(), points.read_bytes()) == (False, b"mine")
        assert call(*both, "--overwrite") == 0
        assert (tum.read_bytes(), points.read_bytes()) == good

    def test_no_map_is_overwritten_least_of_all_the_one_that_is_exported(
        self, state: tuple[Path, ListBus], tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        good = lab(state).read_bytes()
        (tmp_path / "lab.tum").write_bytes(good)
        (tmp_path / "other.prismmap").write_bytes(good)
        (tmp_path / "kept.map").write_bytes(good)
        (tmp_path / "here").symlink_to(tmp_path)
        names = ("other.prismmap", "lab.tum", "here/lab.tum", "kept.map")
        for what, name in zip(("--ply", "--tum") * 2, names, strict=True):
            assert call("export", tmp_path / "lab.tum", what, tmp_path / name, "--overwrite") == 3
            assert re.fullmatch(rf"prism-edge: error: .*{name}.*\n", capsys.readouterr().err)
        assert {(tmp_path / name).read_bytes() for name in names} == {good}

    @pytest.mark.parametrize(
        ("words", "why"),
        [
            ((), "nothing to write"),
            (("--of", "base", "--ply", "b"), "give that too"),
            (("--of", "robot", "--tum", "a"), "invalid choice"),
            (("--tum", ""), "empty name"),
            (("--tum", "a", "--ply", "./a"), "the same file"),
        ],
    )
    def test_a_wrong_command_line_is_2(
        self, words: tuple[str, ...], why: str, capsys: pytest.CaptureFixture[str]
    ) -> None:
        with pytest.raises(SystemExit) as ended:
            call("export", "lab", *words)
        assert ended.value.code == 2
        assert why in capsys.readouterr().err

    @pytest.mark.parametrize("target", ["nowhere/a.tum", "/proc/a.tum"])
    def test_a_target_that_can_not_be_written_is_refused_before_the_map_is_read(
        self, target: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        assert call("export", "/no.prismmap", "--ply", tmp_path / "a.ply", "--tum", tmp_path / target) == 3
        assert capsys.readouterr().err.count("\n") == 1
        assert list(tmp_path.iterdir()) == []

    def test_a_full_disk_leaves_nothing_and_says_so(
        self,
        state: tuple[Path, ListBus],
        tmp_path: Path,
        capsys: pytest.CaptureFixture[str],
        monkeypatch: pytest.MonkeyPatch,
    ) -> None:
        def full(path: Path, data: bytes) -> None:
            with path.open("wb") as file:
                file.write(data[:10])
            raise OSError(28, "No space left on device")

        monkeypatch.setattr(Path, "write_bytes", full)
        assert call("export", lab(state), "--ply", tmp_path / "a.ply") == 74
        said = f"prism-edge: error: {tmp_path / 'a.ply'}: No space left on device\n"
        assert capsys.readouterr().err == said
        assert list(tmp_path.iterdir()) == []

    def test_a_map_without_stamps_has_points_but_no_trajectory(
        self, state: tuple[Path, ListBus], tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        old, tum, points = changed(state, tmp_path, **{STAMPS: None}), tmp_path / "a.tum", tmp_path / "a.ply"
        assert call("export", old, "--tum", tum, "--ply", points) == 10
        assert re.fullmatch(r"prism-edge: error: .*doesn't say when.*--tum\n", capsys.readouterr().err)
        assert not tum.exists()
        assert not points.exists()
        assert call("export", old, "--ply", points) == 0
        assert "taken      not said\n" in shown(old, capsys)

    def test_keyframes_without_a_stamp_are_left_out_and_counted(
        self, state: tuple[Path, ListBus], tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        stamps = map_file.unpack(lab(state).read_bytes())[0][STAMPS]
        some, tum = changed(state, tmp_path, **{STAMPS: [None, *stamps[1:]]}), tmp_path / "a.tum"
        assert call("export", some, "--tum", tum) == 0
        assert read_tum(tum).stamps.tolist() == stamps[1:]
        assert "warning: left out: 1 keyframes that an earlier build made" in capsys.readouterr().err
        assert " s (not said of 1)\n" in shown(some, capsys)

    def test_a_map_without_a_mount_takes_the_present_one_and_says_so(
        self, state: tuple[Path, ListBus], tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        old, tum = changed(state, tmp_path, **{MOUNT: None}), tmp_path / "a.tum"
        moved = "frames.base_from_camera_xyz=[0, 0, 9]"
        assert call("export", old, "--tum", tum, "--set", moved) == 0
        assert read_tum(tum).poses[0][:3, 3] == pytest.approx((0, 0, 9), abs=1e-3)
        assert "warning: the map is without its camera's place" in capsys.readouterr().err
        assert call("export", lab(state), "--tum", tum, "--overwrite", "--set", moved) == 0
        assert read_tum(tum).poses[0][:3, 3] == pytest.approx(SEAT[:3, 3], abs=1e-3)
        assert capsys.readouterr().err == ""

    def test_a_part_without_a_place_is_left_out_and_counted(
        self, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        made = BackendWorker(replace(CONFIG, state=StateConfig(directory=str(tmp_path))), ListBus("keyframe"))
        here, there = Teller(), Teller(seed=1, first=10)
        for i in range(3):
            made._absorb(here.keyframe(pose_at(0.2 * i)))
        away = [there.keyframe(pose_at(9.0 + 0.2 * i)) for i in range(2)]
        for k in away:
            seen = np.where(k.points >= 0, k.points + 5000, -1)
            made._absorb(replace(k, points=seen, new_points=k.new_points + 5000, part=10))
        assert made._save_map("lab").ok
        path, tum = tmp_path / "maps" / "lab.prismmap", tmp_path / "a.tum"
        assert call("export", path, "--tum", tum) == 0
        assert "left out: 2 keyframes in parts whose place in map is not known" in capsys.readouterr().err
        assert len(read_tum(tum)) == 3
        assert "keyframes  5, 2 of them apart, without a place in map\n" in shown(path, capsys)


def shown(path: Path, capsys: pytest.CaptureFixture[str]) -> str:
    capsys.readouterr()
    assert call("show", path) == 0
    return capsys.readouterr().out


class TestShow:
    def test_what_a_map_holds(self, state: tuple[Path, ListBus], capsys: pytest.CaptureFixture[str]) -> None:
        info, arrays = map_file.unpack(lab(state).read_bytes())
        lines = {line[:11].strip(): line[11:] for line in shown(lab(state), capsys).splitlines()}
        assert lines["file"] == f"{lab(state)}, {lab(state).stat().st_size / 1e6:.1f} MB"
        assert lines["saved"] == f"{info['saved']} {info['program']}"
        count = len(arrays["keyframes"])
        assert (lines["keyframes"], lines["points"]) == (str(count), str(len(arrays["points"])))
        assert lines["cameras"] == f"pinhole 320x240 ({count} keyframes)"
        last = max(info[STAMPS])
        assert lines["taken"] == f"0.000000000 to {last // 10**9}.{last % 10**9:09d} s"
        assert lines["scale"] == "1.3499 ± 0.1755 m per map unit"  # 0.05 and 0.12 of it
        assert lines["learnt by"] == "film@012345"
        assert lines["mount"] == (
            "base_from_camera_xyz [0.3000, -0.1000, 0.5000], _xyzw [-0.7304, 0.4217, -0.2686, 0.4653]"
        )
        film = footage()
        way = np.array([(SEAT @ film.poses[k.index])[:3, 3] for k in state[1].of("keyframe")])
        extent = [float(v) for v in re.findall(r"[\d.]+(?= [xm])", lines["extent"])]
        assert extent == pytest.approx(np.ptp(way, axis=0), abs=0.05)

    def test_what_a_file_says_in_words_reaches_no_terminal_as_it_is(
        self, state: tuple[Path, ListBus], tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        odd = changed(state, tmp_path, robot="r\x1b[2J\nkeyframes  9" + 500 * "x", saved=5)
        said = shown(odd, capsys)
        assert "robot      r?[2J?keyframes  9xxx" in said
        assert "\x1b" not in said
        assert max(map(len, said.splitlines())) < 200

    def test_a_shutter_that_was_found(
        self, state: tuple[Path, ListBus], tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        assert "keyframes); rows read over 24.2 ms, as found\n" in shown(
            changed(state, tmp_path, readout_ms=24.16), capsys
        )

    def test_a_name_is_one_of_the_state_directory(
        self,
        state: tuple[Path, ListBus],
        tmp_path: Path,
        capsys: pytest.CaptureFixture[str],
        monkeypatch: pytest.MonkeyPatch,
    ) -> None:
        monkeypatch.chdir(tmp_path)
        (tmp_path / "lab").write_bytes(b"another file")
        monkeypatch.setenv("STATE_DIRECTORY", str(state[0]))
        assert call("show", "lab") == 0
        assert f"file       {lab(state)}" in capsys.readouterr().out
        assert call("show", "lab.prismmap") == 10, "a file here, which there is not"
        assert call("show", "./lab") == 10
        err = capsys.readouterr().err
        assert "lab.prismmap: can't read the map: No such file" in err
        assert "lab: not a sound map" in err


def no_keyframes(path: Path) -> None:
    info, arrays = map_file.unpack(path.read_bytes())
    kept = {name: array[:0] for name, array in arrays.items()}
    path.write_bytes(map_file.pack({**info, STAMPS: []}, {**kept, "starts": np.zeros(1, np.int64)}))


@pytest.mark.parametrize("action", ["show", "export"])
@pytest.mark.parametrize(
    ("spoil", "why"),
    [
        (lambda path: path.unlink(), "No such file"),
        (lambda path: path.write_bytes(b""), "does not begin as a map"),
        (lambda path: path.write_bytes(b"ply\n" * 100), "does not begin as a map"),
        (lambda path: path.write_bytes(path.read_bytes()[:-100]), "truncated?"),
        (lambda path: path.write_bytes(path.read_bytes()[:-8] + b"spoiled!"), "damaged?"),
        (lambda path: (path.unlink(), os.mkfifo(path)), "is no file"),
        (lambda path: os.truncate(path, map_file.LARGEST_FILE + 1), "a map has at most"),
        (lambda path: (path.unlink(), path.mkdir()), "Is a directory"),
        (no_keyframes, "has 0 keyframes"),
    ],
)
def test_what_is_no_sound_map_is_one_line_and_10(
    action: str,
    spoil: Any,
    why: str,
    state: tuple[Path, ListBus],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path, out = tmp_path / "bad.prismmap", tmp_path / "a.ply"
    path.write_bytes(lab(state).read_bytes())
    spoil(path)
    assert call(action, path, *(["--ply", out] if action == "export" else [])) == 10
    said = capsys.readouterr()
    assert said.out == ""
    assert re.fullmatch(rf"prism-edge: error: {path}: .*{re.escape(why)}.*\n", said.err)
    assert not out.exists()


@pytest.mark.parametrize("info", [{"log_scale": None}, {"scale_sigma": "x"}, {STAMPS: [1]}, {MOUNT: [1]}])
def test_values_that_can_not_be_are_one_line_and_10(
    info: dict[str, object], state: tuple[Path, ListBus], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert call("show", changed(state, tmp_path, **info)) == 10
    assert re.fullmatch(r"prism-edge: error: .*changed\.prismmap: .*\n", capsys.readouterr().err)


@pytest.mark.parametrize(
    ("name", "why"), [("office", "maps; there are: lab"), ("-", "is no name"), ("", "is no name")]
)
def test_a_name_that_is_none_is_10(
    name: str, why: str, state: tuple[Path, ListBus], capsys: pytest.CaptureFixture[str]
) -> None:
    assert call("show", name, "--set", f"state.directory={state[0]}") == 10
    assert why in capsys.readouterr().err
