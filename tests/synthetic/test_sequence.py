"""The generated sequence against independent truth: ray casting, reprojection, and the readers."""

from __future__ import annotations

import hashlib
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from prism_edge.bus.pack import pack, rgb
from prism_edge.config import DepthConfig, SourceConfig
from prism_edge.depth import open_network
from prism_edge.evaluation.trajectory import read_tum
from prism_edge.geometry.poses import inverse, transform
from prism_edge.sources.open import open_source
from tests.synthetic.network import write_tiny_network
from tests.synthetic.render import Renderer
from tests.synthetic.scene import furnished_room, hand_held_path
from tests.synthetic.sequence import synthetic_camera, write_sequence

SMALL = synthetic_camera(320, 240)
POSES = hand_held_path(200, 30.0)


@pytest.fixture(scope="module")
def room():
    return furnished_room(0)


def cast(faces, origin, direction) -> float:
    """Distance along a ray to the nearest rectangle, in units of the direction's length."""
    nearest = np.inf
    for face in faces:
        towards = face.normal @ direction
        if towards >= 0:  # seen from behind
            continue
        along = face.normal @ (face.corner - origin) / towards
        hit = origin + along * direction - face.corner
        within = 0 <= hit @ face.right <= face.width and 0 <= hit @ face.down <= face.height
        if within and 0 < along < nearest:
            nearest = along
    return nearest


@pytest.mark.parametrize("frame", [0, 77, 199])
def test_depth_agrees_with_rays_cast_one_by_one(room, frame):
    _, depth = Renderer(room, SMALL).draw(POSES[frame])
    rng = np.random.default_rng(frame)
    pose, wrong = POSES[frame], 0
    for x, y in zip(rng.integers(0, 320, 300), rng.integers(0, 240, 300), strict=True):
        ray = pose[:3, :3] @ np.array([(x - SMALL.cx) / SMALL.fx, (y - SMALL.cy) / SMALL.fy, 1.0])
        wrong += abs(depth[y, x] / cast(room, pose[:3, 3], ray) - 1) > 1e-4
    assert wrong <= 1  # a ray that an edge's rounding catches
    assert depth.min() > 0.3


def test_texture_stays_on_the_surfaces(room):
    renderer = Renderer(room, SMALL)
    first, depth = renderer.draw(POSES[40])
    second, depth_2 = renderer.draw(POSES[48])
    y, x = np.mgrid[0:240, 0:320]
    rays = np.stack([(x - SMALL.cx) / SMALL.fx, (y - SMALL.cy) / SMALL.fy, np.ones(x.shape)], axis=2)
    seen = transform(inverse(POSES[48]) @ POSES[40], (rays * depth[:, :, None]).reshape(-1, 3))
    at = SMALL.project(seen).astype(np.float32).reshape(240, 320, 2)
    warped = cv2.remap(second, at[..., 0], at[..., 1], cv2.INTER_LINEAR).astype(float)
    behind = cv2.remap(depth_2, at[..., 0], at[..., 1], cv2.INTER_NEAREST)
    same = np.abs(behind / seen[:, 2].reshape(240, 320) - 1) < 0.01
    assert np.linalg.norm(POSES[48][:3, 3] - POSES[40][:3, 3]) > 0.05
    assert same.mean() > 0.7
    warp, still = (np.mean(np.abs(image.astype(float) - first)[same]) for image in (warped, second))
    assert warp < 3.0
    assert still > 8.0


def test_the_path_is_smooth_and_of_a_hand_held_camera():
    steps = np.linalg.norm(np.diff(POSES[:, :3, 3], axis=0), axis=1)
    assert steps.max() * 30 < 1.2  # m/s
    assert 1.0 < np.ptp(POSES[:, 0, 3]) < 2.0
    assert np.linalg.det(POSES[:, :3, :3]) == pytest.approx(1.0)


def test_corners_are_many_and_found_again(room):
    renderer = Renderer(room, synthetic_camera())
    orb = cv2.ORB_create(1000, fastThreshold=10)
    first, second = (orb.detectAndCompute(renderer.draw(POSES[i])[0], None)[1] for i in (60, 66))
    assert len(first) == len(second) == 1000
    matches = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(first, second)
    assert sum(match.distance < 40 for match in matches) > 400


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return write_sequence(tmp_path_factory.mktemp("sequence"), frames=6, seed=3)


def test_the_readers_take_it_as_a_tum_recording(folder: Path):
    source = open_source(SourceConfig(uri=str(folder)))
    assert source.camera == synthetic_camera()
    assert source.frame_count == 6
    with source:
        images = [source.read() for _ in range(6)]
        assert source.read() is None
    assert [round(image.stamp_ns * 30 / 1e9) for image in images] == list(range(6))
    assert images[0].pixels.shape == (480, 640, 3)


def test_the_truth_is_the_path(folder: Path):
    truth = read_tum(folder / "groundtruth.txt")
    assert truth.poses == pytest.approx(POSES[:6], abs=1e-8)
    depth = cv2.imread(str(folder / "depth" / "0.100000.png"), cv2.IMREAD_UNCHANGED) / 5000.0
    _, exact = Renderer(furnished_room(3), synthetic_camera()).draw(POSES[3])
    assert np.abs(depth - exact).max() < 1.1e-4


def test_the_tiny_network_reads_metres_from_what_the_bus_carries(folder: Path, tmp_path: Path):
    network = open_network(str(write_tiny_network(tmp_path / "tiny.onnx")), DepthConfig())
    camera = synthetic_camera()
    for name in ("0.000000", "0.166667"):
        image, colour = pack(cv2.imread(str(folder / "rgb" / f"{name}.png")))
        frame = SimpleNamespace(image=image, colour=colour, camera=camera.to_array())
        answer = network.infer(rgb(frame), camera)
        depth = cv2.imread(str(folder / "depth" / f"{name}.png"), cv2.IMREAD_UNCHANGED) / 5000.0
        error = np.log(answer.depth / cv2.resize(depth, (80, 60), interpolation=cv2.INTER_AREA))
        assert abs(np.median(error)) < 0.01
        assert np.std(error) < 0.02


def test_one_seed_gives_the_same_bytes_another_does_not(folder: Path, tmp_path: Path):
    def digest(where: Path) -> str:
        hasher = hashlib.sha256()
        for path in sorted(where.rglob("*.*")):
            hasher.update(path.relative_to(where).as_posix().encode() + path.read_bytes())
        return hasher.hexdigest()

    furnished_room.cache_clear()  # painted anew it is to be the same, too
    assert digest(write_sequence(tmp_path / "same", frames=6, seed=3)) == digest(folder)
    assert digest(write_sequence(tmp_path / "other", frames=6, seed=4)) != digest(folder)
