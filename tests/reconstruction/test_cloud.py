"""Points that fall into one voxel, counted by hand; depth maps of a room against its faces."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from prism_edge.reconstruction import cloud as cloud_module
from prism_edge.reconstruction.cloud import Voxels, lay
from prism_edge.scale.gate import image_pixels
from tests.reconstruction.room import faces, from_the_walls, looks


def grey(values: list[int]) -> np.ndarray:
    return np.repeat(np.array(values, np.uint8)[:, None], 3, axis=1)


def test_a_voxel_is_the_weighted_mean_of_what_fell_into_it() -> None:
    voxels = Voxels(0.1)
    points = np.array([[0.01, 0.02, 0.03], [0.05, 0.06, 0.07], [-0.01, 0.0, 0.0], [0.0, 5.0, -3.0]])
    up = np.tile([0.0, 0.0, 1.0], (4, 1))
    voxels.add(points, up, grey([10, 40, 100, 200]), np.array([3.0, 1.0, 1.0, 1.0]))
    made = voxels.cloud()
    found = {tuple(np.floor(p / 0.1).astype(int)): i for i, p in enumerate(made.points)}
    assert len(found) == len(made.points) == 3, "-0.01 and 0.01 are two voxels"
    at = found[0, 0, 0]
    np.testing.assert_allclose(made.points[at], (3 * points[0] + points[1]) / 4)
    assert made.colours[at].tolist() == [18, 18, 18]  # 17.5
    np.testing.assert_allclose(made.normals, np.tile([0, 0, 1], (3, 1)))


def test_normals_of_a_voxel_that_differ_have_a_mean_of_length_one() -> None:
    voxels = Voxels(0.1)
    aside = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    voxels.add(np.full((2, 3), 0.05), aside, grey([0, 0]), np.ones(2))
    np.testing.assert_allclose(voxels.cloud().normals, [[np.sqrt(0.5), 0.0, np.sqrt(0.5)]])


def test_what_lies_beyond_the_grid_is_left_out() -> None:
    voxels = Voxels(0.001)
    points = np.array([[0.0, 0, 0], [2000, 0, 0], [0, -1e12, 0], [np.nan, 0, 0], [0, np.inf, 0]])
    voxels.add(points, points, grey([1, 2, 3, 4, 5]), np.ones(5))
    assert len(voxels.cloud().points) == 1


def test_an_empty_one() -> None:
    made = Voxels(0.1).cloud()
    assert made.points.shape == made.normals.shape == made.colours.shape == (0, 3)


@given(st.integers(0, 2**32 - 1), st.integers(1, 60))
def test_neither_order_nor_portions_matter(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    points, colours = rng.normal(size=(count, 3)), rng.integers(0, 256, (count, 3), dtype=np.uint8)
    weights = rng.uniform(0.1, 2.0, count)
    whole, parts = Voxels(0.5), Voxels(0.5)
    whole.add(points, points, colours, weights)
    order = rng.permutation(count)
    for some in np.array_split(order, 3):
        parts.add(points[some], points[some], colours[some], weights[some])
    one, other = whole.cloud(), parts.cloud()
    np.testing.assert_allclose(one.points, other.points, atol=1e-12)
    np.testing.assert_allclose(one.normals, other.normals, atol=1e-9)
    assert np.abs(one.colours.astype(int) - other.colours).max() <= 1


def test_many_points_are_laid_together_on_the_way(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(1)
    portions = [rng.normal(size=(50, 3)) for _ in range(6)]
    plain = Voxels(0.3)
    monkeypatch.setattr(cloud_module, "_FLUSH", 80)
    flushed = Voxels(0.3)
    for points in portions:
        flushed.add(points, points, np.zeros((50, 3), np.uint8), np.ones(50))
        assert flushed._count < 80
    monkeypatch.undo()
    for points in portions:
        plain.add(points, points, np.zeros((50, 3), np.uint8), np.ones(50))
    np.testing.assert_allclose(plain.cloud().points, flushed.cloud().points, atol=1e-12)


def test_a_rooms_depth_lies_on_its_faces_with_their_normals() -> None:
    look = looks()[2]
    voxels = Voxels(0.002)  # so small that nothing is averaged over an edge
    lay(voxels, look.view, np.ones(look.view.depth.shape, bool), look.colours)
    made = voxels.cloud()
    assert len(made.points) > 10_000
    assert from_the_walls(made.points).max() < 0.003
    normals = np.array([face.normal for face in faces()])
    assert np.median((made.normals @ normals.T).max(axis=1)) > 0.9999
    to_camera = look.view.world_from_camera[:3, 3] - made.points
    assert (np.sum(to_camera * made.normals, axis=1) > 0).mean() > 0.999


def test_edges_and_what_is_not_kept_are_left_out() -> None:
    look = looks()[2]
    depth = np.full_like(look.view.depth, 2.0)
    depth[:, 80:] = 4.0
    voxels, kept = Voxels(0.001), np.zeros(depth.shape, bool)
    kept[60, :] = True
    lay(voxels, look.with_depth(depth).view, kept, look.colours)
    made = voxels.cloud()
    assert len(made.points) == 160 - 2 - 2, "without the picture's rim, and the two at the step"


def test_the_nearer_view_weighs_more() -> None:
    """By the square: a view at half the distance counts four times."""
    look, voxels = looks()[2], Voxels(1000.0)
    near, far = np.full_like(look.view.depth, 1.0), np.full_like(look.view.depth, 2.0)
    pose, back = np.eye(4), np.eye(4)
    pose[:3, 3] = 500.0  # amid one voxel
    back[:3, 3] = 500.0
    back[2, 3] -= 0.5  # sees its plane half a metre behind the other's
    for depth, seen_from in ((near, pose), (far, back)):
        view = replace(look.with_depth(depth).view, world_from_camera=seen_from)
        assert lay(voxels, view, depth > 0, look.colours) == (158 * 118, 0)
    (point,) = voxels.cloud().points
    assert point[2] == pytest.approx(501.0 + 0.5 * 0.2, abs=1e-6)


def test_what_is_seen_along_its_surface_is_left_out() -> None:
    """A plane that rises away from the camera under four degrees, and under thirty."""
    look = looks()[2]
    rays = look.view.camera.normalise(image_pixels(look.view))
    for degrees, seen in ((4.0, False), (30.0, True)):
        # through the middle of the picture at 2 m, inclined to the ray there
        slope = np.tan(np.radians(degrees))
        depth = (2.0 * slope / (slope + rays[:, 1])).reshape(look.view.depth.shape).astype(np.float32)
        middle = np.zeros(depth.shape, bool)
        middle[58:63, 70:90] = True
        voxels = Voxels(0.0001)
        laid, _ = lay(voxels, look.with_depth(np.maximum(depth, 0)).view, middle, look.colours)
        assert (laid > 0) == seen
