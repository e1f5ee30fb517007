"""`prism-edge reconstruct` on a generated room: its cloud against the room's faces, and what it refuses."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from prism_edge.backend import map_file
from prism_edge.backend.global_map import GlobalMap
from prism_edge.backend.map_mount import mount_info
from prism_edge.backend.stored_map import KnownScale, to_arrays
from prism_edge.cli.main import main
from prism_edge.config import FramesConfig, TrackingConfig
from prism_edge.depth.contract import INVERSE_RELATIVE
from prism_edge.depth.session import OnnxNetwork
from prism_edge.depth.several_views import SeveralViewsNetwork
from prism_edge.geometry.cameras import Camera
from prism_edge.geometry.mount import base_from_camera
from prism_edge.geometry.poses import inverse, transform
from prism_edge.messages import Keyframe
from prism_edge.sources.base import Slot
from prism_edge.sources.image_sequence import ImageSequence
from prism_edge.tracking.features import OrbExtractor
from prism_edge.tracking.place_index import PlaceIndex
from tests.depth.test_several_views import write as write_several
from tests.synthetic.messages import blank
from tests.synthetic.network import TinyNetwork, save, tiny_graph, write_tiny_network
from tests.synthetic.render import Renderer
from tests.synthetic.scene import furnished_room, hand_held_path
from tests.synthetic.sequence import RATE_HZ, synthetic_camera, write_sequence

FRAMES, APART, SEED = 85, 12, 3
CAMERA = synthetic_camera(320, 240)
LOG_SCALE = 0.2  # the map's unit is 1.22 m
POINTS = 400
MOUNT = base_from_camera(FramesConfig())


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the recording `seq`, the true map `room.prismmap` of it, and networks."""
    folder = tmp_path_factory.mktemp("room")
    write_sequence(folder / "seq", FRAMES, CAMERA.width, CAMERA.height, seed=SEED)
    (folder / "room.prismmap").write_bytes(true_map())
    write_tiny_network(folder / "metric.onnx", TinyNetwork(gain=1.3))
    write_tiny_network(folder / "inverse.onnx", TinyNetwork(name="inverse", depth_kind=INVERSE_RELATIVE))
    return folder


def path() -> list[np.ndarray]:
    """world_from_camera of the keyframes; the world is the first one's camera."""
    poses = hand_held_path(FRAMES, RATE_HZ)
    return [inverse(poses[0]) @ pose for pose in poses[::APART]]


def true_map(
    stamped: bool = True, camera: Camera = CAMERA, mount: np.ndarray = MOUNT, twice: bool = False
) -> bytes:
    """Keyframes where they are, and points of the surfaces that they see, wherever they are seen.

    ``twice``: a second recording, with the same stamps, has gone the way back in the map.
    """
    renderer = Renderer(furnished_room(SEED), CAMERA)
    first = hand_held_path(FRAMES, RATE_HZ)[0]
    way = path() + (path()[::-1] if twice else [])
    drawn = [renderer.draw(first @ pose) for pose in way]
    draw = [depth for _, depth in drawn]
    found = [OrbExtractor(TrackingConfig()).extract(luma, CAMERA) for luma, _ in drawn]
    unit, rng = np.exp(-LOG_SCALE), np.random.default_rng(0)
    places: list[np.ndarray] = []
    for pose, depth in zip(way, draw, strict=True):
        x, y = rng.integers(8, 312, POINTS), rng.integers(8, 232, POINTS)
        z = depth[y, x].astype(float)
        rays = CAMERA.normalise(np.column_stack([x, y]))
        places.append(transform(pose, np.column_stack([rays * z[:, None], z])))
    unlike = np.zeros((POINTS * len(way), 4), np.uint64)
    everything, world, told = np.vstack(places), GlobalMap(), set()
    for k, (pose, depth, corners) in enumerate(zip(way, draw, found, strict=True)):
        local = transform(inverse(pose), everything)
        pixels = CAMERA.project(np.where(local[:, 2:] > 0.1, local, (0, 0, 1)))
        inside = np.all((pixels > 1) & (pixels < (318, 238)), axis=1) & (local[:, 2] > 0.1)
        at = np.rint(np.where(inside[:, None], pixels, 0)).astype(int)
        inside &= np.abs(depth[at[:, 1], at[:, 0]] / np.where(inside, local[:, 2], 1) - 1) < 0.01
        shown = np.flatnonzero(inside)
        new = np.array([p for p in shown.tolist() if p not in told], np.int64)
        told |= set(shown.tolist())
        placed = pose.copy()
        placed[:3, 3] *= unit
        shows = np.concatenate([shown, np.full(len(corners), -1)])
        stamp_ns = round(k % len(path()) * APART / RATE_HZ * 1e6) * 1000
        world.absorb(
            blank(
                Keyframe,
                id=k,
                index=k * APART,
                stamp_ns=stamp_ns,
                epoch=0,
                camera_model=camera.model,
                camera=camera.to_array(),
                world_from_camera=placed,
                pixels=np.vstack([pixels[shown], corners.pixels]).astype(np.float32),
                octaves=np.concatenate([np.zeros(len(shown)), corners.octaves]).astype(np.uint8),
                descriptors=np.vstack([unlike[: len(shown)], corners.descriptors]).view(np.uint8),
                points=shows.astype(np.int64),
                depths=np.where(shows >= 0, local[shows, 2] * unit, 0).astype(np.float32),
                parallax_deg=np.where(shows >= 0, 3.0, 0).astype(np.float32),
                new_points=new,
                new_positions=everything[new] * unit,
                new_by=np.full(len(new), k),
                anchor=max(k - 1, 0),
                world_from_anchor=placed,
                travelled=0.1 * k,
            )
        )
    for point in world.points.values():
        point.parallax_deg = 3.0
    if not stamped:
        for keyframe in world.keyframes.values():
            keyframe.taken_ns = None
    info, arrays = to_arrays(world, PlaceIndex())
    return map_file.pack({**info, **KnownScale(LOG_SCALE, 0.01).info, **mount_info(mount)}, arrays)


Call = Callable[..., int]


@pytest.fixture
def call(room: Path, tmp_path: Path) -> Call:
    """The command on the room, writing out.ply into this test's folder."""

    def call(*more: object, source: object = "", map: object = "", model: object = "metric.onnx") -> int:
        words = ["reconstruct", source or room / "seq", "--map", map or room / "room.prismmap"]
        named = room / str(model) if str(model).endswith(".onnx") else model
        return main([str(w) for w in (*words, "--model", named, "--out", tmp_path / "out.ply", *more)])

    return call


def cloud(file: Path) -> tuple[np.ndarray, np.ndarray]:
    """Points and colours of a PLY file."""
    header, _, body = file.read_bytes().partition(b"end_header\n")
    dtype = np.dtype([("p", "<f4", 3), ("n", "<f4", 3), ("c", "u1", 3)])
    rows = np.frombuffer(body, dtype)
    assert f"element vertex {len(rows)}\n".encode() in header
    return rows["p"].astype(float), rows["c"]


def from_the_walls(points: np.ndarray) -> np.ndarray:
    """Distances (n,) of points in `map` to the room's nearest face."""
    first = hand_held_path(FRAMES, RATE_HZ)[0]
    world = transform(first @ inverse(MOUNT), points)
    best = np.full(len(world), np.inf)
    for face in furnished_room(SEED):
        local = world - face.corner
        u, v = local @ face.right, local @ face.down
        over = np.maximum(0, np.maximum(-u, u - face.width)), np.maximum(0, np.maximum(-v, v - face.height))
        best = np.minimum(best, np.sqrt((local @ face.normal) ** 2 + over[0] ** 2 + over[1] ** 2))
    return best


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


def test_it_is_the_same_each_time(call: Call, tmp_path: Path) -> None:
    assert call("--width", 120) == 0
    first = (tmp_path / "out.ply").read_bytes()
    assert call("--width", 120, "--overwrite") == 0
    assert (tmp_path / "out.ply").read_bytes() == first


def test_keyframes_without_a_picture_are_counted(
    call: Call, room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shorter = shutil.copytree(room / "seq", tmp_path / "seq")
    lines = (shorter / "rgb.txt").read_text().splitlines()
    (shorter / "rgb.txt").write_text("\n".join(lines[:60]) + "\n")
    assert call("--no-pictures", source=shorter) == 0
    heard = capsys.readouterr()
    assert "5 of 8 keyframes" in heard.out
    assert "left out: 3 keyframes, of whose time the recording has no picture" in heard.err


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


def test_of_a_map_of_two_recordings_each_gives_its_own_keyframes(
    call: Call, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Stamps begin anew in the second, which went the way back: half of its pictures are of other places."""
    (tmp_path / "both.prismmap").write_bytes(true_map(twice=True))
    assert call("--no-pictures", "--width", 160, "--voxel", 0.05, map=tmp_path / "both.prismmap") == 0
    heard = capsys.readouterr()
    assert "8 of 16 keyframes" in heard.out
    assert "left out: 8 keyframes, of whose time the recording's picture is another" in heard.err
    assert np.median(from_the_walls(cloud(tmp_path / "out.ply")[0])) < 0.01


def test_a_recording_that_is_looped_in_the_configuration_ends(
    call: Call, room: Path, tmp_path: Path
) -> None:
    shorter = shutil.copytree(room / "seq", tmp_path / "seq")
    lines = (shorter / "rgb.txt").read_text().splitlines()
    (shorter / "rgb.txt").write_text("\n".join(lines[:60]) + "\n")
    assert call("--no-pictures", "--set", "source.loop=true", source=shorter) == 0


def test_a_picture_that_can_not_be_read_is_counted(
    call: Call, room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    damaged = shutil.copytree(room / "seq", tmp_path / "seq")
    sorted((damaged / "rgb").iterdir())[APART].write_bytes(b"no picture")
    assert call("--no-pictures", source=damaged) == 0
    heard = capsys.readouterr()
    assert "7 of 8 keyframes" in heard.out
    assert "left out: 1 keyframes, whose picture can't be read" in heard.err


@pytest.mark.parametrize("model", ["metric.onnx", "several.onnx"])
def test_networks_see_pictures_upright(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, model: str
) -> None:
    """A map that says that its camera hung upside down, whatever the configuration says of today's."""
    over = MOUNT @ np.diag([-1.0, -1.0, 1.0, 1.0])
    (tmp_path / "over.prismmap").write_bytes(true_map(mount=over))
    shown: list[np.ndarray] = []
    for kind, name in ((OnnxNetwork, "raw"), (SeveralViewsNetwork, "infer")):
        method = getattr(kind, name)

        def spied(self: object, pictures: Any, *more: Any, method: Any = method) -> Any:
            shown.extend([pictures] if isinstance(pictures, np.ndarray) else pictures)
            return method(self, pictures, *more)

        monkeypatch.setattr(kind, name, spied)
    write_several(tmp_path / "several.onnx", size=(320, 240), tinted=True)
    path = tmp_path / model if model == "several.onnx" else model
    assert call("--no-pictures", "--width", 160, map=tmp_path / "over.prismmap", model=path) == 0
    truth = Renderer(furnished_room(SEED), CAMERA).draw(hand_held_path(FRAMES, RATE_HZ)[0])[0]
    # Before it are those of the warm-up.
    taken = [p for p in shown if p.shape == (240, 320, 3)][-9 if model == "several.onnx" else -8 :]
    first = cv2.cvtColor(taken[0], cv2.COLOR_RGB2GRAY)
    turned = truth[::-1, ::-1].astype(float)
    assert np.corrcoef(first.ravel(), turned.ravel())[0, 1] > 0.95
    world = cloud(tmp_path / "out.ply")[0]
    assert np.median(from_the_walls(transform(MOUNT @ inverse(over), world))) < 0.01


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


def test_what_the_mask_hides_is_not_in_the_cloud(call: Call, tmp_path: Path) -> None:
    mask = np.full((240, 320), 255, np.uint8)
    mask[:, :160] = 0
    cv2.imwrite(str(tmp_path / "mask.png"), mask)
    assert call("--no-pictures", "--width", 160, "--agree", 1) == 0
    whole = len(cloud(tmp_path / "out.ply")[0])
    masked = ("--overwrite", "--mask", tmp_path / "mask.png")
    assert call("--no-pictures", "--width", 160, "--agree", 1, *masked) == 0
    assert len(cloud(tmp_path / "out.ply")[0]) < 0.75 * whole
    cv2.imwrite(str(tmp_path / "small.png"), mask[:100])
    assert call("--overwrite", "--mask", tmp_path / "small.png") == 3


def test_a_video_s_stamps_are_those_of_the_pictures_that_were_read(
    call: Call, room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """What is expected before they are read is a little off."""
    peek = ImageSequence.peek

    def expected(self: ImageSequence) -> Slot | None:
        slot = peek(self)
        return None if slot is None else Slot(slot.index, slot.stamp_ns + 7_000_000 * (slot.index % 3))

    def truly(self: ImageSequence) -> Any:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(ImageSequence, "peek", peek)
            return read(self)

    read = ImageSequence.read
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ImageSequence, "peek", expected)
        patch.setattr(ImageSequence, "read", truly)
        assert call("--no-pictures", "--width", 160) == 0
    assert "8 of 8 keyframes" in capsys.readouterr().out


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


def test_another_recording_is_refused(
    call: Call, room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = shutil.copytree(room / "seq", tmp_path / "seq")
    lines = [line for line in (other / "rgb.txt").read_text().splitlines() if not line.startswith("#")]
    (other / "rgb.txt").write_text("\n".join(f"9{line}" for line in lines) + "\n")  # nine seconds later
    assert call(source=other) == 4
    assert "has no picture of any keyframe: is it the recording of this map?" in capsys.readouterr().err


def test_files_that_are_there_and_other_endings_are_refused(
    call: Call, room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "out.ply").write_text("mine")
    assert call() == 3
    assert "give --overwrite" in capsys.readouterr().err
    assert (tmp_path / "out.ply").read_text() == "mine"
    assert call("--out", tmp_path / "out.pcd") == 3
    assert "PLY" in capsys.readouterr().err
    shutil.copy(room / "room.prismmap", tmp_path / "map.ply")
    assert call("--out", tmp_path / "map.ply", "--overwrite") == 3
    assert "is a map, which no cloud replaces" in capsys.readouterr().err


def test_a_map_without_stamps_and_one_of_another_camera_are_refused(
    call: Call, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "a.prismmap").write_bytes(true_map(stamped=False))
    assert call(map=tmp_path / "a.prismmap") == 10
    assert "none of its keyframes says when it was taken" in capsys.readouterr().err
    (tmp_path / "b.prismmap").write_bytes(true_map(camera=synthetic_camera(640, 480)))
    assert call(map=tmp_path / "b.prismmap") == 4
    assert "pictures of 320x240, but the map is of 640x480" in capsys.readouterr().err


WRONG = [("--voxel", "0"), ("--voxel", "nan"), ("--agree", "0"), ("--agree", "10"), ("--far", "-1")]
WRONG += [("--width", "x"), ("--width", "63"), ("--width", "1921")]


@pytest.mark.parametrize("more", WRONG)
def test_options_that_can_not_be_are_refused(call: Call, more: tuple[str, str]) -> None:
    with pytest.raises(SystemExit) as ended:
        call(*more)
    assert ended.value.code == 2
