"""A recording of a generated room, the true map of it, and how far from its walls a cloud is."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np

from prism_edge.backend import map_file
from prism_edge.backend.global_map import GlobalMap
from prism_edge.backend.map_mount import mount_info
from prism_edge.backend.map_scale import KnownScale
from prism_edge.backend.stored_map import to_arrays
from prism_edge.config import FramesConfig, TrackingConfig
from prism_edge.depth.contract import INVERSE_RELATIVE
from prism_edge.geometry.cameras import Camera
from prism_edge.geometry.mount import base_from_camera
from prism_edge.geometry.poses import inverse, transform
from prism_edge.messages import Keyframe
from prism_edge.tracking.features import OrbExtractor
from prism_edge.tracking.place_index import PlaceIndex
from tests.synthetic.messages import blank
from tests.synthetic.network import TinyNetwork, write_tiny_network
from tests.synthetic.render import Renderer
from tests.synthetic.scene import distances, furnished_room, hand_held_path
from tests.synthetic.sequence import RATE_HZ, synthetic_camera, write_sequence

FRAMES, APART, SEED = 85, 12, 3
CAMERA = synthetic_camera(320, 240)
LOG_SCALE = 0.2  # the map's unit is 1.22 m
POINTS = 60  # of each keyframe
MOUNT = base_from_camera(FramesConfig())

Call = Callable[..., int]


def write_room(folder: Path) -> Path:
    """The recording `seq`, the true map `room.prismmap` of it, and networks, in a folder."""
    write_sequence(folder / "seq", FRAMES, CAMERA.width, CAMERA.height, seed=SEED)
    (folder / "room.prismmap").write_bytes(true_map())
    write_tiny_network(folder / "metric.onnx", TinyNetwork(gain=1.3))
    write_tiny_network(folder / "inverse.onnx", TinyNetwork(name="inverse", depth_kind=INVERSE_RELATIVE))
    return folder


def path() -> list[np.ndarray]:
    """world_from_camera of the keyframes; the world is the first one's camera."""
    poses = hand_held_path(FRAMES, RATE_HZ)
    return [inverse(poses[0]) @ pose for pose in poses[::APART]]


@cache
def pictures() -> list[tuple[np.ndarray, np.ndarray]]:
    """Luma and depth of the keyframes."""
    renderer, first = Renderer(furnished_room(SEED), CAMERA), hand_held_path(FRAMES, RATE_HZ)[0]
    return [renderer.draw(first @ pose) for pose in path()]


def true_map(
    stamped: bool = True,
    camera: Camera = CAMERA,
    mount: np.ndarray = MOUNT,
    twice: bool = False,
    other: Camera | None = None,
    shown: np.ndarray | None = None,
) -> bytes:
    """Keyframes where they are, and points of the surfaces that they see, wherever they are seen.

    ``twice``: a second recording, with the same stamps, went the way back in the map, by ``other``.
    ``shown``: keyframes have corners there alone.
    """
    way, drawn = path(), pictures()
    if twice:
        way, drawn = way + way[::-1], drawn + drawn[::-1]
    draw = [depth for _, depth in drawn]
    extractor = OrbExtractor(TrackingConfig())
    if shown is not None:
        extractor.look_only_at(shown)
    found = [extractor.extract(luma, CAMERA) for luma, _ in drawn]
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
        made_by = other if other is not None and k >= len(path()) else camera
        stamp_ns = round(k % len(path()) * APART / RATE_HZ * 1e6) * 1000
        world.absorb(
            blank(
                Keyframe,
                id=k,
                index=k * APART,
                stamp_ns=stamp_ns,
                epoch=0,
                camera_model=made_by.model,
                camera=made_by.to_array(),
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
    return distances(transform(first @ inverse(MOUNT), points), furnished_room(SEED))
