"""Keyframe messages of a cloud of points, as a tracker would send them."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from prism_edge.backend.global_map import GlobalKeyframe, GlobalMap, GlobalPoint
from prism_edge.backend.mapper import Mapper
from prism_edge.geometry.poses import inverse, transform
from prism_edge.messages import Depth, Keyframe, MapUpdate
from tests.synthetic.messages import blank
from tests.tracking.cloud import CAMERA, Cloud

SHARED = 100  # points, between neighbours of a chain
NO_IDS = np.zeros(0, np.int64)


def poses_of(world: GlobalMap) -> dict[int, np.ndarray]:
    """world_from_camera of every keyframe, the remembered culled ones carried by their anchors."""
    ids, poses = world.table()
    return dict(zip(ids.tolist(), poses, strict=True))


class Teller:
    """Sends a keyframe for each pose; a point's id is its place in the cloud."""

    def __init__(
        self, count: int = 300, seed: int = 0, noise_px: float = 0.0, epoch: int = 0, first: int = 0
    ) -> None:
        self.cloud = Cloud(count, seed)
        self.noise_px, self.epoch, self.first = noise_px, epoch, first
        self.told: set[int] = set()
        self.poses: list[np.ndarray] = []

    def keyframe(self, pose: np.ndarray, correction: np.ndarray | None = None) -> Keyframe:
        """The next keyframe, truly at ``pose``; its tracker's world is ``correction`` @ the true one."""
        number = self.first + len(self.poses)
        features, shown = self.cloud.view(pose, self.noise_px)
        new = np.array([p for p in shown.tolist() if p not in self.told], np.int64)
        moved = np.eye(4) if correction is None else correction
        before = self.poses[-1] if self.poses else pose
        self.told |= set(new.tolist())
        self.poses.append(pose)
        depths = transform(inverse(pose), self.cloud.positions[shown])[:, 2]
        return blank(
            Keyframe,
            id=number,
            index=10 * number,
            stamp_ns=number * 300_000_000,
            epoch=self.epoch,
            camera_model=CAMERA.model,
            camera=CAMERA.to_array(),
            world_from_camera=moved @ pose,
            pixels=features.pixels.astype(np.float32),
            octaves=features.octaves.astype(np.uint8),
            descriptors=features.descriptors.view(np.uint8).reshape(-1, 32),
            points=shown.astype(np.int64),
            depths=depths.astype(np.float32),
            parallax_deg=np.full(len(shown), 3.0, np.float32),
            new_points=new,
            new_positions=transform(moved, self.cloud.positions[new]),
            new_by=np.full(len(new), number),
            anchor=max(number - 1, self.first),
            world_from_anchor=moved @ before,
            travelled=0.1 * number,
        )


def quiet(message: Keyframe, **changes: object) -> Keyframe:
    """A further keyframe with the given changes of the map, which itself sees nothing."""
    empty = {
        "pixels": np.zeros((0, 2), np.float32),
        "octaves": np.zeros(0, np.uint8),
        "descriptors": np.zeros((0, 32), np.uint8),
        "points": NO_IDS,
        "depths": np.zeros(0, np.float32),
        "parallax_deg": np.zeros(0, np.float32),
        "new_points": NO_IDS,
        "new_positions": np.zeros((0, 3)),
        "new_by": NO_IDS,
    }
    follows = {
        "id": message.id + 1,
        "anchor": message.id,
        "world_from_anchor": message.world_from_camera,
    }
    arrays = {k: np.array(v, np.int64) if isinstance(v, list) else v for k, v in changes.items()}
    return replace(message, **(empty | follows | arrays))


def told_depth(
    depth: np.ndarray, image_to_depth: np.ndarray, frame_sigma: float, model: str, keyframe: int = 0
) -> Depth:
    """A network's answer."""
    rest = np.zeros((0, 0), np.float32), np.zeros(0, np.float32)
    said = keyframe, 0, 0, model, 0.0, 0.0, True, ""
    return Depth(*said, image_to_depth, depth, *rest, frame_sigma=frame_sigma)


def step(
    mapper: Mapper, message: Keyframe, depth: np.ndarray, image_to_depth: np.ndarray
) -> MapUpdate | None:
    """What the worker does with a keyframe and its depth, while the map's unit is a metre."""
    mapper.absorb(message)
    mapper.add_depth(message, told_depth(depth, image_to_depth, math.nan, ""), 0.0)
    return mapper.optimise(message.id, 0.0)


def check(world: GlobalMap) -> None:
    """Keyframes and points name each other."""
    seen = {(k, p) for k, keyframe in world.keyframes.items() for p in keyframe.observed}
    assert seen == {(k, p) for p, point in world.points.items() for k in point.keyframes}


def depth_at_keypoints(world: GlobalMap, cloud: Cloud, poses: list[np.ndarray], factor: float = 1.0) -> None:
    """Give each keyframe the true depth (times ``factor``) of what its keypoints show."""
    for k, keyframe in world.keyframes.items():
        depths = np.zeros(len(keyframe.pixels))
        for p, keypoint in keyframe.observed.items():
            depths[keypoint] = factor * transform(inverse(poses[k]), cloud.positions[p][None])[0, 2]
        keyframe.depths = depths


def chain(poses: list[np.ndarray], first: int = 0, world: GlobalMap | None = None) -> GlobalMap:
    """Keyframes of which each shares a hundred points with the next alone, all 3 units before it."""
    world = world or GlobalMap()
    for i, pose in enumerate(poses):
        k = first + i
        ids = range(SHARED * k, SHARED * (k + 2))
        world.keyframes[k] = GlobalKeyframe(
            k, k, CAMERA, pose.copy(), np.zeros((2 * SHARED, 2)), np.ones(2 * SHARED), {}
        )
        for keypoint, p in enumerate(ids):
            world.points.setdefault(p, GlobalPoint(transform(pose, np.array([[0.0, 0.0, 3.0]]))[0]))
            world.observe(k, p, keypoint)
    return world
