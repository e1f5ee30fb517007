"""Pictures and depth of a wall and a box whose geometry is known, and of whole worlds by ray casting."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from sources.sim.ray_casting import all_surfaces, cast

from prism_edge.geometry.cameras import Camera
from prism_edge.geometry.poses import Array, from_rt, inverse, so3_exp, transform
from prism_edge.messages import U8
from prism_edge.sources.sim import SimSource
from prism_edge.sources.sim.floorplan import make_plan
from prism_edge.sources.sim.renderer import Renderer
from prism_edge.sources.sim.surfaces import SHELL, Shop
from prism_edge.sources.sim.world import Cell, World

CAMERA = Camera(160, 120, 130.0, 130.0, 79.5, 59.5)
CORNER = np.array([-1.0, 2.0, 1.5])  # of a wall 2 m ahead (y), 2 m wide, 1.2 m high
RIGHT, DOWN = np.array([2.0, 0, 0]), np.array([0, 0, -1.2])
AHEAD = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # looks along y, x right, z up


def chequered(rng: np.random.Generator, height: int, width: int) -> U8:
    """Eight by four fields, each of its own colour: blue grows to the right, green downwards."""
    image = np.zeros((height, width, 3), dtype=np.uint8)
    y, x = np.mgrid[:height, :width]
    image[:, :, 0] = 20 + 30 * (8 * x // width)
    image[:, :, 1] = 20 + 60 * (4 * y // height)
    return image


def red(rng: np.random.Generator, height: int, width: int) -> U8:
    return np.full((height, width, 3), (0, 0, 250), dtype=np.uint8)


def renderer(with_box: bool = False) -> Renderer:
    """The wall alone in black space, or a red box before its middle, nearer by 1 m and to the left."""
    textures: list[U8] = []
    shop = Shop(np.random.default_rng(0), textures)
    shop.add(CORNER, RIGHT, DOWN, chequered, 200.0, SHELL)
    if with_box:
        sides = dict.fromkeys(("front", "back", "side", "top", "bottom"), red)
        shop.add_box(np.array([-0.2, 1.0, 0.9]), np.array([0.2, 0.2, 0.2]), 0.4, sides)
    low, high = np.full(3, -9.0), np.full(3, 9.0)
    world = World((Cell(low, high, shop.done(), ()),), textures, make_plan(False, 0))
    return Renderer(world, CAMERA)


def pose(
    x: float = 0.0, y: float = 0.0, z: float = 0.9, turn: tuple[float, float, float] = (0, 0, 0)
) -> Array:
    return from_rt(AHEAD @ so3_exp(np.array(turn, dtype=float)), np.array([x, y, z]))


@pytest.mark.parametrize(
    "view", [pose(), pose(0.3, 0.4, 1.0, (0.1, -0.3, 0.2)), pose(-0.8, 0.9, 0.6, (-0.2, 0.5, -0.3))]
)
def test_fields_of_the_wall_are_where_they_project_to(view: Array) -> None:
    picture = renderer().draw(view, {}).pixels
    seen = 0
    for column in range(8):
        for row in range(4):
            middle = CORNER + RIGHT * (column + 0.5) / 8 + DOWN * (row + 0.5) / 4
            in_camera = transform(inverse(view), middle[None])
            x, y = np.rint(CAMERA.project(in_camera)[0]).astype(int) if in_camera[0, 2] > 0 else (-1, -1)
            if 1 <= x < 159 and 1 <= y < 119:
                seen += 1
                assert picture[y, x, :3] == pytest.approx([20 + 30 * column, 20 + 60 * row, 0], abs=2)
    assert seen > 6


def test_edges_lie_where_they_should_to_part_of_a_pixel() -> None:
    # brightness summed along a row measures where an edge lies, finer than pixels
    widened = []
    for shift in np.linspace(0.0, 0.02, 9):
        picture = renderer().draw(pose(x=float(shift)), {}).pixels
        row = picture[60, :, 1].astype(float) / picture[60, 80, 1]
        left, right = CAMERA.project(np.array([[-1.0 - shift, 0, 2.0], [1.0 - shift, 0, 2.0]]))[:, 0]
        widened += [left - (79.5 - row[:80].sum()), 79.5 + row[80:].sum() - right]
    # a fine pixel, half a pixel wide, is filled where an edge touches it
    assert np.all(np.abs(np.array(widened) - 0.25) < 0.27)
    assert np.mean(widened) == pytest.approx(0.25, abs=0.1)


def test_depth_is_that_of_the_plane() -> None:
    view = pose(0.3, 0.4, 1.0, (0.1, -0.3, 0.2))
    depth = renderer().depth(view, {})
    y, x = np.mgrid[0:120, 0:160]
    rays = np.stack([(x - 79.5) / 130.0, (y - 59.5) / 130.0, np.ones_like(x, dtype=float)], axis=2)
    turned = rays @ view[:3, :3].T
    expected = (2.0 - view[1, 3]) / turned[:, :, 1]  # the wall is y = 2
    place = view[:3, 3] + turned * expected[:, :, None]
    margin = 0.02
    inside = (np.abs(place[:, :, 0]) < 1 - margin) & (np.abs(place[:, :, 2] - 0.9) < 0.6 - margin)
    outside = (np.abs(place[:, :, 0]) > 1 + margin) | (np.abs(place[:, :, 2] - 0.9) > 0.6 + margin)
    assert inside.sum() > 3000
    assert np.abs(depth / expected - 1)[inside].max() < 1e-6
    assert np.all(depth[outside] == 0)


def test_what_is_nearer_hides() -> None:
    view = pose()
    drawing = renderer(with_box=True)
    picture, depth = drawing.draw(view, {}).pixels, drawing.depth(view, {})
    is_box = picture[:, :, 2] > 240
    assert is_box.sum() > 300
    assert depth[is_box].max() < 1.2
    is_wall = (picture[:, :, 2] == 0) & (picture[:, :, 1] > 15) & (depth > 0)
    assert is_wall.sum() > 5000
    assert depth[is_wall].min() > 1.9


def test_far_textures_are_averaged_not_sampled() -> None:
    def stripes(rng: np.random.Generator, height: int, width: int) -> U8:
        image = np.zeros((height, width, 3), dtype=np.uint8)
        image[:, ::2] = 200
        return image

    textures: list[U8] = []
    shop = Shop(np.random.default_rng(0), textures)
    shop.add(CORNER, RIGHT, DOWN, stripes, 400.0, SHELL)
    cell = Cell(np.full(3, -99.0), np.full(3, 99.0), shop.done(), ())
    picture = Renderer(World((cell,), textures, make_plan(False, 0)), CAMERA).draw(pose(y=-4.0), {}).pixels
    wall = picture[55:65, 70:90, 0]
    assert wall.mean() == pytest.approx(100, abs=3)
    assert wall.std() < 3


@pytest.mark.parametrize("index", [0, 130, 777])
def test_depth_agrees_with_casting_rays_in_a_room(room: SimSource, index: int) -> None:
    check_depth(room, index)


@pytest.mark.parametrize("share", [0.0, 0.05, 0.21, 0.4, 0.63])
def test_depth_agrees_with_casting_rays_through_doors(loop: SimSource, share: float) -> None:
    check_depth(loop, int(share * loop.frame_count))


@pytest.mark.parametrize("share", [0.0, 0.11, 0.23, 0.52, 0.77])
def test_depth_agrees_with_casting_rays_along_streets(street: SimSource, share: float) -> None:
    check_depth(street, int(share * street.frame_count))


@pytest.mark.parametrize("share", [0.0, 0.08, 0.17, 0.29, 0.36, 0.48, 0.61, 0.74, 0.9])
def test_depth_agrees_with_casting_rays_across_crossings(town_: SimSource, share: float) -> None:
    check_depth(town_, int(share * town_.frame_count))


def test_shrunk_textures_are_bounded_and_the_pictures_are_not_changed_by_it(
    street: SimSource, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawing, _ = street._opened()
    views = [street.pose(index) for index in (0, 150, 300, 0)]
    expected = [drawing.draw(view, {}).pixels for view in views]
    monkeypatch.setattr("prism_edge.sources.sim.renderer._MOST_KEPT", 1 << 20)
    small = Renderer(drawing.world, drawing.camera)
    for view, pixels in zip(views, expected, strict=True):
        assert np.array_equal(small.draw(view, {}).pixels, pixels)
        assert 0 < sum(texture.nbytes for texture in small._shrunk.values()) <= 1 << 20


def check_depth(source: SimSource, index: int) -> None:
    depth, view = source.depth(index), source.pose(index)
    rng = np.random.default_rng(index)
    x, y, ones = rng.integers(0, 160, 500), rng.integers(0, 120, 500), np.ones(500)
    camera, surfaces = source.camera, all_surfaces(source, index)
    rays = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, ones], axis=1)
    expected = cast(surfaces, view[:3, 3], rays @ view[:3, :3].T)
    assert np.all(np.isfinite(expected))  # no ray leaves the world
    right = np.abs(depth[y, x] / expected - 1) < 1e-4
    assert right.mean() > 0.95
    # Edges are widened by a tenth of a pixel: what is wrong there is right a little beside.
    doubtful = np.flatnonzero(~right)
    x, y = x[doubtful], y[doubtful]
    for dx, dy in ((0.2, 0), (-0.2, 0), (0, 0.2), (0, -0.2)):
        rays = np.stack([(x + dx - camera.cx) / camera.fx, (y + dy - camera.cy) / camera.fy], axis=1)
        rays = np.concatenate([rays, np.ones((len(x), 1))], axis=1)
        beside = cast(surfaces, view[:3, 3], rays @ view[:3, :3].T)
        right[doubtful] |= np.abs(depth[y, x] / beside - 1) < 0.03
    assert right.mean() > 0.99  # things below a pixel are left out


@pytest.mark.parametrize(("first", "second"), [(100, 106), (300, 304)])
def test_two_views_show_the_same_colours(room: SimSource, first: int, second: int) -> None:
    here, there = (room.image(k).pixels.astype(np.float32) for k in (first, second))
    depth = room.depth(first)
    y, x = np.mgrid[0:120, 0:160]
    pixels = np.stack([x.ravel(), y.ravel()], axis=1).astype(float)
    rays = np.concatenate([room.camera.normalise(pixels), np.ones((len(pixels), 1))], axis=1)
    points = transform(inverse(room.pose(second)) @ room.pose(first), rays * depth.reshape(-1, 1))
    target = room.camera.project(points).reshape(120, 160, 2).astype(np.float32)
    warped = cv2.remap(there, target[:, :, 0], target[:, :, 1], cv2.INTER_LINEAR)
    other = cv2.remap(room.depth(second), target[:, :, 0], target[:, :, 1], cv2.INTER_NEAREST)
    visible = np.abs(other / points[:, 2].reshape(120, 160) - 1) < 0.01
    assert visible.mean() > 0.5
    assert np.abs(warped - here)[visible].mean() < 4.0
    assert np.abs(there - here)[visible].mean() > 2 * np.abs(warped - here)[visible].mean()
