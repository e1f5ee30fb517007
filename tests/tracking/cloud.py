"""A made-up world of points with descriptors of their own, seen without images."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from prism_edge.geometry.cameras import Camera
from prism_edge.geometry.poses import inverse, se3_exp, transform
from prism_edge.tracking.features import Features
from prism_edge.tracking.local_map import LocalKeyframe, LocalMap
from prism_edge.tracking.pose_from_map import PoseFromMap

CAMERA = Camera(640, 480, 500.0, 440.0, 309.5, 251.5)  # of no symmetry: fx for fy must show
FACTORS = 1.2 ** np.arange(8.0)
BY_POINTS = PoseFromMap(FACTORS)
NEAREST_AT_LEVEL_0 = 8.0  # m: a corner nearer than this is seen on a higher level


def descriptors(rng: np.random.Generator, count: int) -> np.ndarray:
    """Random 256-bit descriptors (count, 4): 128 bits apart, give or take 30."""
    return rng.integers(0, 2**64, (count, 4), dtype=np.uint64)


def flipped(rng: np.random.Generator, words: np.ndarray, bits: int) -> np.ndarray:
    """The descriptors with up to ``bits`` of their bits turned over."""
    out = words.copy()
    for _ in range(bits):
        word, bit = rng.integers(0, 4, len(out)), rng.integers(0, 64, len(out)).astype(np.uint64)
        out[np.arange(len(out)), word] ^= np.uint64(1) << bit
    return out


def pose_at(*twist: float) -> np.ndarray:
    """world_from_camera (4, 4) of a twist: x y z, then rotation; missing numbers are 0."""
    return se3_exp(np.array([*twist, *(0.0,) * (6 - len(twist))]))


class Cloud:
    """Points in a box 2 to 6 m in front of the origin, which looks along z."""

    def __init__(self, count: int = 500, seed: int = 0) -> None:
        self.rng = np.random.default_rng(seed)
        depth = self.rng.uniform(2.0, 6.0, count)
        rays = self.rng.uniform((-0.75, -0.55), (0.75, 0.55), (count, 2))
        self.positions = np.column_stack([rays * depth[:, None], depth])
        self.descriptors = descriptors(self.rng, count)

    def view(
        self, world_from_camera: np.ndarray, noise_px: float = 0.0, bits: int = 0
    ) -> tuple[Features, np.ndarray]:
        """Features of what is in the image, and which point of the cloud each shows."""
        local = transform(inverse(world_from_camera), self.positions)
        shown = np.flatnonzero(local[:, 2] > 0.2)
        pixels = CAMERA.project(local[shown])
        inside = np.all((pixels >= 0) & (pixels < (CAMERA.width, CAMERA.height)), axis=1)
        shown, pixels = shown[inside], pixels[inside]
        distance = np.linalg.norm(local[shown], axis=1)
        level = np.rint(np.log(NEAREST_AT_LEVEL_0 / distance) / np.log(1.2))
        octaves = np.clip(level, 0, len(FACTORS) - 1).astype(np.intp)
        pixels = pixels + self.rng.normal(0.0, 1.0, pixels.shape) * noise_px * FACTORS[octaves, None]
        words = flipped(self.rng, self.descriptors[shown], bits)
        return Features.build(pixels, octaves, words, CAMERA.width, CAMERA.height), shown

    def keyframe(
        self, number: int, world_from_camera: np.ndarray, noise_px: float = 0.0, bits: int = 0
    ) -> tuple[LocalKeyframe, np.ndarray]:
        """A keyframe that has no map points yet, and which point of the cloud each keypoint shows."""
        features, shown = self.view(world_from_camera, noise_px, bits)
        none = np.full(len(features), -1, np.int64)
        stamp_ns = 300_000_000 * number
        pose = world_from_camera.copy()
        return LocalKeyframe(number, 10 * number, stamp_ns, pose, CAMERA, features, none), shown

    def mapped(
        self, poses: list[np.ndarray], noise_px: float = 0.0, sigma: float = 0.01, parallax_deg: float = 5.0
    ) -> tuple[LocalMap, list[np.ndarray]]:
        """A map with a keyframe at each pose and every point that any of them sees at its true place."""
        world, shown = LocalMap(), []
        ids = np.full(len(self.positions), -1, np.int64)
        for number, pose in enumerate(poses):
            keyframe, seen = self.keyframe(number, pose, noise_px)
            keyframe.points = ids[seen]
            world.add_keyframe(keyframe)
            free = keyframe.free()
            sigmas = np.full(len(free), sigma)
            ids[seen[free]] = world.add_points(
                keyframe, free, self.positions[seen[free]], sigmas, parallax_deg
            )
            shown.append(seen)
        return world, shown


def observations(world: LocalMap) -> dict[int, dict[int, int]]:
    """What the keyframes say: point -> keyframe -> keypoint."""
    seen: dict[int, dict[int, int]] = {}
    for keyframe in world.keyframes.values():
        for keypoint in keyframe.observed().tolist():
            point = int(keyframe.points[keypoint])
            assert keyframe.id not in seen.get(point, {}), "one keyframe sees a point twice"
            seen.setdefault(point, {})[keyframe.id] = keypoint
    return seen


def check(world: LocalMap) -> None:
    """The map's own bookkeeping agrees with what its keyframes say."""
    seen, table = observations(world), world.points
    assert all(a < b for a, b in pairwise(table.ids.tolist()))
    ids, counts = table.ids[table.alive].tolist(), table.observations[table.alive].tolist()
    alive = dict(zip(ids, counts, strict=True))
    assert set(seen) <= set(alive), "a keyframe sees a point that is gone"
    for point, count in alive.items():
        assert count == len(seen.get(point, {})), f"point {point} counts {count} keyframes"
    references = set(table.reference[table.alive].tolist())
    assert references <= set(world.keyframes), "a point's first ray is a keyframe's that is gone"


def walk(count: int, step: float = 0.15, seed: int = 0) -> LocalMap:
    """Keyframes side by side, in whose images points come and go."""
    world, _ = Cloud(400, seed).mapped([pose_at(step * i, 0.0, 0.0, 0.0, 0.02 * i) for i in range(count)])
    return world


def counted(world: LocalMap, keyframe: int) -> float:
    """Share of its points that three others see."""
    seen = [keyframes for keyframes in observations(world).values() if keyframe in keyframes]
    return sum(len(keyframes) >= 4 for keyframes in seen) / len(seen)
