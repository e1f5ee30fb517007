"""From where a finished map was seen: its keyframes in metres, and what each saw of its points."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np

from prism_edge.backend.global_map import GlobalKeyframe, GlobalMap
from prism_edge.backend.map_export import MetricMap
from prism_edge.geometry.cameras import Camera
from prism_edge.geometry.poses import Array, inverse, transform
from prism_edge.tracking.features import Features
from prism_edge.tracking.point_table import TRIANGULATED_DEG

_NEAREST = 1e-3  # m before a camera


@dataclass(frozen=True)
class Viewpoint:
    """A keyframe, metres in `map`, and the triangulated points that it shows."""

    keyframe: int
    stamp_ns: int
    map_from_camera: Array  # (4, 4)
    camera: Camera
    pixels: Array  # (m, 2) of those points, raw: as the camera took them
    depths: Array  # (m,) their depth along z
    beside: tuple[int, ...]  # keyframes that share points with it, those that share most first
    features: Features  # of its picture


def viewpoints(world: GlobalMap, metric: MetricMap) -> list[Viewpoint]:
    """Keyframes with a place in `map` and a stamp, by their stamps; ``metric`` is the same map in metres."""
    home = set(metric.keyframes)
    placed = zip(metric.keyframes, metric.stamps, metric.map_from_camera, strict=True)
    made = [
        _viewpoint(world, world.keyframes[number], stamp_ns, pose, metric.metres, home)
        for number, stamp_ns, pose in placed
        if stamp_ns is not None
    ]
    return sorted(made, key=lambda viewpoint: viewpoint.stamp_ns)


def _viewpoint(
    world: GlobalMap, keyframe: GlobalKeyframe, stamp_ns: int, pose: Array, metres: float, home: set[int]
) -> Viewpoint:
    shared: Counter[int] = Counter()
    for point in keyframe.observed:
        shared.update(world.points[point].keyframes & home)
    del shared[keyframe.id]
    firm = {p: k for p, k in keyframe.observed.items() if world.points[p].parallax_deg >= TRIANGULATED_DEG}
    places = np.array([world.points[p].position for p in firm]).reshape(-1, 3)
    z = metres * transform(inverse(keyframe.world_from_camera), places)[:, 2]
    raw = keyframe.camera.distort_pixels(keyframe.pixels[list(firm.values())].reshape(-1, 2))
    before = z > _NEAREST
    return Viewpoint(
        keyframe.id,
        stamp_ns,
        pose,
        keyframe.camera,
        raw[before],
        z[before],
        tuple(k for k, _ in sorted(shared.items(), key=lambda item: (-item[1], item[0]))),
        keyframe.features,
    )
