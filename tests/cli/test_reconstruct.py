"""`prism-edge reconstruct` on a generated room: its cloud against the room's faces, and what it refuses."""

from __future__ import annotations

import math
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from prism_edge.backend import map_file
from prism_edge.backend.map_scale import KnownScale
from prism_edge.cli import reconstruct
from prism_edge.cli.reconstruct_looks import Gathered
from prism_edge.config import Config
from prism_edge.config_file import load
from prism_edge.errors import MapError
from prism_edge.reconstruction.dense import MOST_BESIDE, Options
from prism_edge.scale.gate import GateParameters
from tests.cli.mapped_room import APART, Call, cloud, from_the_walls, true_map
from tests.depth.test_several_views import write as write_several
from tests.synthetic.network import TinyNetwork, save, tiny_graph, write_tiny_network
from tests.synthetic.sequence import synthetic_camera


@pytest.mark.parametrize("model", ["metric.onnx", "inverse.onnx", "sensor"])
def test_the_cloud_is_the_room(
    call: Call, tmp_path: Path, capsys: pytest.CaptureFixture[str], model: str
) -> None:
    """In metres of `map`, whatever unit the map and the network have."""
    assert call("--voxel", 0.05, "--width", 240, model=model) == 0
    points, colours = cloud(tmp_path / "out.ply")
    errors = from_the_walls(points)
    assert len(points) > 2000
    assert np.median(errors) < 0.01
    # The networks' maps are of 80 pixels: objects' outlines are drawn out to what is behind them.
    assert np.percentile(errors, 90) < (0.03 if model == "sensor" else 0.12)
    assert colours.std() > 5
    said = capsys.readouterr().out
    assert "8 of 8 keyframes" in said
    assert f"out.ply: {len(points)} points" in said


def test_options_do_what_they_say(call: Call, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert call("--voxel", 0.05, "--no-pictures", "--width", 160) == 0
    points, _ = cloud(tmp_path / "out.ply")
    assert "pictures say" not in capsys.readouterr().out
    assert call("--voxel", 0.1, "--no-pictures", "--width", 160, "--far", 2, "--agree", 6, "--overwrite") == 0
    fewer, _ = cloud(tmp_path / "out.ply")
    assert 0 < len(fewer) < 0.5 * len(points)
    assert call("--voxel", 0.05, "--no-pictures", "--agree", 1, "--width", 160, "--overwrite") == 0
    assert len(cloud(tmp_path / "out.ply")[0]) > len(points)


def test_the_camera_is_the_map_s_whatever_a_robot_s_own_file_names(
    call: Call, capsys: pytest.CaptureFixture[str]
) -> None:
    """A simulated world would refuse that; and this one is not the map's, which is all that is wrong."""
    said = []
    for more in ([], ["--set", "source.camera=camera.yaml"]):
        assert call(*more, source="sim:room?frames=3") != 0
        said.append(capsys.readouterr().err)
    assert said[0] == said[1]
    assert "simulated camera" not in said[0]


def test_it_is_the_same_each_time(call: Call, tmp_path: Path) -> None:
    assert call("--width", 120) == 0
    first = (tmp_path / "out.ply").read_bytes()
    assert call("--width", 120, "--overwrite") == 0
    assert (tmp_path / "out.ply").read_bytes() == first


def test_several_views_go_together(
    call: Call, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Eight keyframes in threes: the last two with the one before."""
    write_several(tmp_path / "several.onnx", size=(320, 240), tinted=True)
    assert call("--voxel", 0.05, "--no-pictures", "--width", 160, model=tmp_path / "several.onnx") == 0
    points, _ = cloud(tmp_path / "out.ply")
    assert len(points) > 2000
    assert np.median(from_the_walls(points)) < 0.01
    assert "depth by several (CPUExecutionProvider): 8 of 8 keyframes" in capsys.readouterr().out


def test_fewer_keyframes_than_it_takes_views_are_refused(
    call: Call, room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_several(tmp_path / "several.onnx", size=(320, 240), tinted=True)
    two = shutil.copytree(room / "seq", tmp_path / "seq")
    lines = (two / "rgb.txt").read_text().splitlines()
    (two / "rgb.txt").write_text("\n".join(lines[: APART + 3]) + "\n")
    assert call(source=two, model=tmp_path / "several.onnx") == 5
    assert "takes 3 keyframes at once, and 2 have a picture" in capsys.readouterr().err


@pytest.mark.parametrize("misbehaviour", ["constant", "nan", "negative"])
def test_depth_of_nothing_is_no_cloud(
    call: Call, tmp_path: Path, capsys: pytest.CaptureFixture[str], misbehaviour: str
) -> None:
    path = write_tiny_network(tmp_path / "bad.onnx", TinyNetwork(misbehaviour=misbehaviour))
    assert call(model=path) == 10
    error = capsys.readouterr().err
    assert "left out: 8 keyframes, of which the network gives no depth" in error
    assert "no surface that 3 keyframes agree on" in error
    assert not (tmp_path / "out.ply").exists()


@pytest.mark.parametrize(
    ("more", "code", "words"),
    [
        ({"model": "nothing.onnx"}, 5, "there is no such file"),
        ({"model": "none"}, 5, "a cloud needs depth"),
        ({"source": "/nowhere"}, 4, "does not exist"),
        ({"source": "v4l2:/dev/video0"}, 4, "which has no past"),
        ({"map": "/nowhere.prismmap"}, 10, "can't read the map"),
    ],
)
def test_what_can_not_be_is_said_in_a_line(
    call: Call, tmp_path: Path, capsys: pytest.CaptureFixture[str], more: dict, code: int, words: str
) -> None:
    assert call(**more) == code
    error = capsys.readouterr().err.strip().splitlines()
    assert words in error[-1]
    assert not (tmp_path / "out.ply").exists()


def test_the_gate_takes_out_what_the_network_doubts(call: Call, tmp_path: Path) -> None:
    """tau of the configuration, or of the card; open where the gate is ablated."""
    shut = ("--set", "gate.tau=0.0001", "--set", "gate.temperature=0.00001")
    counts = []
    for gate in ((), (*shut, "--set", "ablate=[dsug]"), shut):
        code = call("--no-pictures", "--width", 160, "--overwrite", *gate)
        counts.append(len(cloud(tmp_path / "out.ply")[0]) if code == 0 else 0)
    assert counts[0] == counts[1] > 2000
    assert counts[2] < 100
    card = replace(TinyNetwork().card(), dsug_tau=0.0001, dsug_temperature=0.00001)
    save(tmp_path / "doubts.onnx", tiny_graph(TinyNetwork()), card)
    code = call("--no-pictures", "--width", 160, "--overwrite", model=tmp_path / "doubts.onnx")
    assert code == 10 or len(cloud(tmp_path / "out.ply")[0]) < 100


def test_a_unit_that_nobody_knows_is_told(
    call: Call, room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    info, arrays = map_file.unpack(true_map())
    (tmp_path / "guess.prismmap").write_bytes(map_file.pack({**info, **KnownScale().info}, arrays))
    assert call("--no-pictures", "--width", 160, map=tmp_path / "guess.prismmap") == 0
    assert "metres are a guess" in capsys.readouterr().err


def test_voxels_too_small_for_the_place_are_told(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("prism_edge.reconstruction.cloud._MOST_STEPS", 32)
    assert call("--no-pictures", "--width", 160, "--voxel", 0.1) == 0
    assert "pixels lie too far out for voxels of 0.1 m" in capsys.readouterr().err


def test_what_a_depth_camera_measured_is_not_held_to_pictures(
    call: Call, capsys: pytest.CaptureFixture[str]
) -> None:
    assert call("--width", 160, model="sensor") == 0
    assert "pictures say" not in capsys.readouterr().out


def test_files_that_are_there_and_other_endings_are_refused(
    call: Call, room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "out.ply").write_text("mine")
    assert call() == 3
    assert "give --overwrite" in capsys.readouterr().err
    assert (tmp_path / "out.ply").read_text() == "mine"
    assert call("--out", tmp_path / "out.pcd") == 3
    assert "PLY" in capsys.readouterr().err
    assert call("--out", tmp_path / "OUT.PLY", map="/nowhere.prismmap") == 10
    assert "can't read the map" in capsys.readouterr().err
    shutil.copy(room / "room.prismmap", tmp_path / "map.ply")
    assert call("--out", tmp_path / "map.ply", "--overwrite") == 3
    assert "is a map, which no command replaces" in capsys.readouterr().err


def test_a_map_without_stamps_and_one_of_another_camera_are_refused(
    call: Call, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "a.prismmap").write_bytes(true_map(stamped=False))
    assert call(map=tmp_path / "a.prismmap") == 10
    assert "none of its keyframes says when it was taken" in capsys.readouterr().err
    (tmp_path / "b.prismmap").write_bytes(true_map(camera=synthetic_camera(640, 480)))
    assert call(map=tmp_path / "b.prismmap") == 4
    assert "pictures of 320x240, but the map is of 640x480" in capsys.readouterr().err


def test_depth_maps_are_as_wide_as_asked_for(call: Call, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []

    def gather(config: Config, mount: object, seen: object, width: int, progress: object) -> None:
        asked.append(width)
        raise MapError("far enough")

    monkeypatch.setattr("prism_edge.cli.reconstruct_looks.gather", gather)
    assert [call("--width", 97), call()] == [MapError.exit_code] * 2
    assert asked == [97, reconstruct.WIDTH]


@pytest.mark.parametrize(
    ("given", "card", "gate"),
    [
        ({}, (0.3, 0.04), (0.6, 0.3, 0.04)),
        ({"gate.tau": 0.2, "gate.temperature": 0.05}, (0.3, 0.04), (0.6, 0.2, 0.05)),
        ({"gate.tau": 0.2}, (0.3, 0.04), (0.6, 0.2, 0.04)),
        ({"gate.tau": 0.2, "gate.temperature": 0.05}, (math.nan, math.nan), (0.6, 0.2, 0.05)),
        ({"gate.tau": 0.2}, (math.nan, math.nan), None),
        ({"gate.temperature": 0.05}, (math.nan, math.nan), None),
        ({"ablate": ["dsug"]}, (0.3, 0.04), None),
    ],
)
def test_options_are_as_given_and_the_gate_is_the_network_s_own_where_it_is_not(
    given: dict, card: tuple[float, float], gate: tuple[float, float, float] | None
) -> None:
    args = SimpleNamespace(voxel=0.5, agree=4, far=6.0, no_pictures=False)
    options = reconstruct._options(args, load(None, {"gate.alpha": 0.6, **given}), Gathered("x", card, False))
    wanted = None if gate is None else GateParameters(*gate)
    assert options == Options(0.5, 4, 6.0, by_pictures=True, gate=wanted)


WRONG = [("--voxel", "0"), ("--voxel", "nan"), ("--agree", "0"), ("--agree", "10"), ("--far", "-1")]
WRONG += [("--width", "x"), ("--width", "63"), ("--width", "1921")]


@pytest.mark.parametrize("more", WRONG)
def test_options_that_can_not_be_are_refused(call: Call, more: tuple[str, str]) -> None:
    with pytest.raises(SystemExit) as ended:
        call(*more)
    assert ended.value.code == 2


def test_help_says_what_the_reconstruction_is_made_with() -> None:
    assert (Options().voxel, Options().agreeing) == (reconstruct.VOXEL, reconstruct.AGREEING)
    assert reconstruct.MOST_AGREEING == MOST_BESIDE + 1


def test_keyframes_that_the_map_can_not_place_or_date_are_counted(
    call: Call, room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    info, arrays = map_file.unpack((room / "room.prismmap").read_bytes())
    stamps = [None if k < 2 else stamp for k, stamp in enumerate(info["stamps"])]
    (tmp_path / "some.prismmap").write_bytes(map_file.pack({**info, "stamps": stamps}, arrays))
    assert call("--no-pictures", "--width", 160, map=tmp_path / "some.prismmap") == 0
    assert "left out: 2 keyframes, whose stamps the map doesn't have" in capsys.readouterr().err
