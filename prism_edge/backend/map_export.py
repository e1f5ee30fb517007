"""A stored map in metres, in the frame `map` that subscribers get poses in; pure."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from prism_edge.backend.connectivity import parts_of
from prism_edge.backend.global_map import GlobalMap
from prism_edge.geometry.poses import Array, inverse, scaled, transform


@dataclass(frozen=True)
class MetricMap:
    """Keyframes (k) by their numbers and points (m) whose place in `map` is known.

    Those of a part that nothing joins to the first keyframe have no place there yet: no `pose` is published
    in it either.
    """

    keyframes: tuple[int, ...]
    stamps: tuple[int | None, ...]  # ns, of each keyframe; None where the map doesn't say
    map_from_camera: Array  # (k, 4, 4) metres
    points: Array  # (m, 3) metres
    metres: float  # per map unit
    mount: Array  # (4, 4) base_from_camera of who began the map, metres
    elsewhere: int  # keyframes without a place there

    @property
    def map_from_base(self) -> Array:
        """Poses (k, 4, 4) of the base that carried the camera as it sat when the map began."""
        return self.map_from_camera @ inverse(self.mount)

    @property
    def extent(self) -> Array:
        """How far the camera has been from one end to the other, along each axis (3) of `map`: metres."""
        return np.ptp(self.map_from_camera[:, :3, 3], axis=0)

    def trajectory(self, of_base: bool) -> list[tuple[int, Array]]:
        """Stamp (ns) and pose (4, 4) in `map` of each keyframe that has one: the base's or the camera's."""
        poses = self.map_from_base if of_base else self.map_from_camera
        return [(s, pose) for s, pose in zip(self.stamps, poses, strict=True) if s is not None]


def metric_map(world: GlobalMap, log_scale: float, mount: Array) -> MetricMap:
    """A map in metres, as poses in it are published (workers/pose_publisher.py).

    ``log_scale`` is the logarithm of metres per map unit; ``mount`` (4, 4) is base_from_camera of who began
    the map, in metres, which no scale multiplies.
    """
    part = parts_of(world)
    home = [world.keyframes[k] for k in sorted(world.keyframes) if k not in part]
    metres = float(np.exp(log_scale))
    poses = scaled(np.array([k.world_from_camera for k in home]), metres)
    there = [p for p in world.points.values() if not p.keyframes <= part.keys()]
    places = metres * np.array([p.position for p in there]).reshape(-1, 3)
    numbers, stamps = tuple(k.id for k in home), tuple(k.taken_ns for k in home)
    points = transform(mount, places)
    return MetricMap(numbers, stamps, mount @ poses, points, metres, mount, len(part))
