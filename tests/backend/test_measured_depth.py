"""Depth from a source that knows how good it is holds the map's scale; a network's doesn't."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from prism_edge.backend.mapper import Mapper
from prism_edge.config import BackendConfig
from prism_edge.geometry.cameras import FISHEYE, Camera
from prism_edge.geometry.poses import inverse, transform
from prism_edge.messages import Keyframe
from tests.backend.world import Teller, poses_of, told_depth
from tests.tracking.cloud import pose_at

TOO_LARGE = 1.1
WIDE = np.array([0.25, 0.0, 0.25, 0.0])
NAN = float("nan")


def true_depth(teller: Teller, keyframe: Keyframe) -> np.ndarray:
    """A depth map in which each keypoint finds its own true depth, in a patch of its own."""
    depth = np.full((120, 160), 3.0, np.float32)
    pose = teller.poses[keyframe.id]
    local = transform(inverse(pose), teller.cloud.positions[keyframe.points])
    for (x, y), z in zip(np.rint(keyframe.pixels / 4).astype(int), local[:, 2], strict=True):
        depth[max(y - 1, 0) : y + 2, max(x - 1, 0) : x + 2] = z
    return depth


def walked(frame_sigma: float) -> float:
    """How far the map is from its true size after a walk of which the tracker made 10 % too much."""
    mapper, teller = Mapper(BackendConfig()), Teller(count=150, noise_px=0.3)
    for i in range(6):
        keyframe = teller.keyframe(pose_at(0.2 * i, 0.0, 0.0, 0.0, -0.03 * i))
        mapper.absorb(keyframe)
        mapper.add_depth(keyframe, told_depth(true_depth(teller, keyframe), WIDE, frame_sigma, ""), 0.0)
    for k in mapper.world.keyframes.values():
        k.world_from_camera = k.world_from_camera.copy()
        k.world_from_camera[:3, 3] *= TOO_LARGE
    for point in mapper.world.points.values():
        point.position = TOO_LARGE * point.position
    for _ in range(3):
        assert mapper.optimise(5, 0.0) is not None
    first, last = (poses_of(mapper.world)[k] for k in (0, 5))
    way = np.linalg.norm(last[:3, 3] - first[:3, 3])
    return float(way / np.linalg.norm(teller.poses[5][:3, 3] - teller.poses[0][:3, 3]))


def test_measured_depth_brings_the_map_to_its_size() -> None:
    assert walked(0.02) == pytest.approx(1.0, abs=0.015)


def test_a_network_s_leaves_it_the_size_that_it_has() -> None:
    assert walked(NAN) == pytest.approx(TOO_LARGE, abs=0.02)


@pytest.mark.parametrize("nonsense", [-1.0, float("inf"), NAN])
def test_a_sigma_that_is_none_is_passed_over(nonsense: float) -> None:
    mapper, teller = Mapper(BackendConfig()), Teller()
    keyframe = teller.keyframe(np.eye(4))
    mapper.absorb(keyframe)
    mapper.add_depth(keyframe, told_depth(true_depth(teller, keyframe), WIDE, nonsense, ""), 0.0)
    assert mapper.world.keyframes[0].depth_sigma == 0.0


def test_perfect_depth_has_some_noise_all_the_same() -> None:
    mapper, teller = Mapper(BackendConfig()), Teller(noise_px=0.3)
    for i in range(3):
        keyframe = teller.keyframe(pose_at(0.2 * i))
        mapper.absorb(keyframe)
        mapper.add_depth(keyframe, told_depth(true_depth(teller, keyframe), WIDE, 0.0, ""), 0.0)
    assert mapper.world.keyframes[0].depth_sigma > 0.0
    assert mapper.optimise(2, 0.0) is not None


def test_a_lens_s_depth_is_where_its_raw_image_has_the_keypoint() -> None:
    """Keypoints are undistorted, the network's picture is not: near its edge they are far apart."""
    lens = Camera(640, 480, 300.0, 301.0, 321.0, 239.0, FISHEYE, (-0.012, 0.04, -0.03, 0.006))
    teller, mapper = Teller(), Mapper(BackendConfig())
    told = teller.keyframe(np.eye(4))
    told = replace(told, camera_model=lens.model, camera=lens.to_array())
    mapper.absorb(told)
    slope = np.tile(np.linspace(2.0, 6.0, 160, dtype=np.float32), (120, 1))
    mapper.add_depth(told, told_depth(slope, WIDE, 0.02, ""), 0.0)
    depths = mapper.world.keyframes[0].depths
    assert depths is not None
    raw = lens.distort_pixels(told.pixels.astype(np.float64))
    there = 2.0 + 4.0 * raw[:, 0] / 4.0 / 159.0
    known = depths > 0
    assert np.sum(known & (np.abs(raw - told.pixels).max(axis=1) > 20.0)) > 20
    assert depths[known] == pytest.approx(there[known], abs=0.02)
