"""What a camera can see of a world, far things first: portals, frustum, facing, and order by separation.

Pure geometry; nothing is drawn here. Cells are convex and open into each other only through portals, so
what a portal shows lies behind everything in the cell it is looked through from. Within a cell the walls
come first, then the bodies, sorted so that none is drawn before one that it may hide.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from prism_edge.geometry.cameras import Camera
from prism_edge.geometry.poses import Array, inverse
from prism_edge.sources.sim.surfaces import SHELL, Surfaces
from prism_edge.sources.sim.world import World

NEAR = 0.05  # m; paths keep farther than this from everything
_IN_OPENING = 4 * NEAR
_LEAST_AREA = 0.7  # pixels
_DEEPEST = 8  # portals looked through in a row
Rect = tuple[int, int, int, int]  # x0, y0, x1, y1 in pixels, the last two exclusive


@dataclass(frozen=True)
class Visible:
    """Surfaces in drawing order, as seen by one camera.

    ``polygons`` (n, 5, 2) are corners in pixels, clipped to the near plane, the last one repeated where
    there are fewer; ``rects`` (n, 4: x0, y0, x1, y1, the last two exclusive) bound where each may be drawn.
    ``image_to_plane`` (n, 3, 3) takes (x, y, 1) to (a, b, 1) / z, where a and b in 0..1 are the place
    along the surface's edges and z is the depth: its last row alone is the inverse depth.
    """

    polygons: Array
    rects: NDArray[np.int64]
    texture: NDArray[np.int64]
    image_to_plane: Array


@dataclass
class _Found:
    rows: Surfaces
    projected: Array  # (n, 4, 3) corners: x z, y z, z
    rect: Rect


def see(world: World, walkers: Mapping[int, Surfaces], camera: Camera, world_from_camera: Array) -> Visible:
    """All that ``camera`` (an ideal pinhole) may see from a pose; ``walkers`` adds surfaces to cells."""
    camera_from_world = inverse(world_from_camera)
    centre = world_from_camera[:3, 3]
    projection = camera.matrix @ camera_from_world[:3]
    whole = (0, 0, camera.width, camera.height)
    found: list[_Found] = []
    _visit(world, walkers, world.cell_at(centre), -1, whole, centre, projection, 0, found)
    found = [item for item in found if len(item.rows.texture)]
    projected = np.concatenate([item.projected for item in found])
    corners = projected[:, :, :2] / np.maximum(projected[:, :, 2:], NEAR)
    polygons = np.concatenate([corners, corners[:, 3:]], axis=1)
    for row in np.flatnonzero((projected[:, :, 2] < NEAR).any(axis=1)):
        polygon = clipped(projected[row])
        polygons[row] = polygon[np.minimum(np.arange(5), len(polygon) - 1)]
    rects = np.concatenate([np.tile(item.rect, (len(item.projected), 1)) for item in found])
    right = np.concatenate([item.rows.right for item in found])
    down = np.concatenate([item.rows.down for item in found])
    corner = np.concatenate([item.rows.origin for item in found]) - centre
    plane_to_image = projection[:, :3] @ np.stack([right, down, corner], axis=2)
    texture = np.concatenate([item.rows.texture for item in found])
    image_to_plane: Array = np.linalg.inv(plane_to_image)
    return Visible(polygons, rects, texture, image_to_plane)


def clipped(corners: Array) -> Array:
    """Pixels (k, 2) of the part of a polygon (n, 3: x z, y z, z) that is beyond the near plane."""
    out = []
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        if a[2] >= NEAR:
            out.append(a)
        if (a[2] >= NEAR) != (b[2] >= NEAR):
            out.append(a + (b - a) * ((NEAR - a[2]) / (b[2] - a[2])))
    return np.array([p[:2] / p[2] for p in out]).reshape(-1, 2)


def _visit(
    world: World,
    walkers: Mapping[int, Surfaces],
    number: int,
    come_from: int,
    rect: Rect,
    centre: Array,
    projection: Array,
    depth: int,
    found: list[_Found],
) -> None:
    """Adds what ``rect`` shows of a cell, after all that its portals show of the cells behind it."""
    cell = world.cells[number]
    for portal in cell.portals:
        if portal.into != come_from and depth < _DEEPEST:
            inner = _through(portal.corners, rect, centre, projection)
            if inner is not None:
                _visit(world, walkers, portal.into, number, inner, centre, projection, depth + 1, found)
    rows, projected = _facing(cell.surfaces, centre, projection, rect)
    if number in walkers:
        moving, seen = _facing(walkers[number], centre, projection, rect)
        rows = rows.joined(moving)
        projected = np.concatenate([projected, seen])
    order = _drawing_order(rows, centre)
    found.append(_Found(rows.at(order), projected[order], rect))


def _through(corners: Array, rect: Rect, centre: Array, projection: Array) -> Rect | None:
    """The part of ``rect`` in which a portal shows, or None."""
    plane = int(np.argmin(np.ptp(corners, axis=0)))
    if abs(centre[plane] - corners[0, plane]) < _IN_OPENING:
        return rect  # too near for the near plane's cut to be harmless; more than shows is drawn over later
    seen = corners @ projection[:, :3].T + projection[:, 3]
    if seen[:, 2].max() <= NEAR:
        return None
    pixels = clipped(seen)
    low, high = np.floor(pixels.min(axis=0)) - 1, np.ceil(pixels.max(axis=0)) + 2
    x0, y0 = max(rect[0], int(low[0])), max(rect[1], int(low[1]))
    x1, y1 = min(rect[2], int(high[0])), min(rect[3], int(high[1]))
    return (x0, y0, x1, y1) if x0 < x1 and y0 < y1 else None


def _facing(surfaces: Surfaces, centre: Array, projection: Array, rect: Rect) -> tuple[Surfaces, Array]:
    """Rows turned towards the camera and not wholly outside ``rect``, and their projected corners."""
    towards = np.einsum("ij,ij->i", centre - surfaces.origin, surfaces.normal) > 0.0
    rows = np.flatnonzero(towards)
    origin, right, down = surfaces.origin[rows], surfaces.right[rows], surfaces.down[rows]
    corners = np.stack([origin, origin + right, origin + right + down, origin + down], axis=1)
    seen = corners @ projection[:, :3].T + projection[:, 3]
    x, y, z = seen[:, :, 0], seen[:, :, 1], seen[:, :, 2]
    # Pixels reach half a pixel beyond their centres, and rounding needs a little room too.
    outside = (z < NEAR).all(axis=1)
    outside |= (x < (rect[0] - 1) * z).all(axis=1) | (x > rect[2] * z).all(axis=1)
    outside |= (y < (rect[1] - 1) * z).all(axis=1) | (y > rect[3] * z).all(axis=1)
    # What covers less than a pixel is left out; cut by the near plane it may be large all the same.
    flat = seen[:, :, :2] / np.maximum(seen[:, :, 2:], NEAR)
    diagonals = flat[:, 2:] - flat[:, :2]
    area = 0.5 * np.abs(diagonals[:, 0, 0] * diagonals[:, 1, 1] - diagonals[:, 0, 1] * diagonals[:, 1, 0])
    outside |= (area < _LEAST_AREA) & (z > NEAR).all(axis=1)
    kept = ~outside
    return surfaces.at(rows[kept]), seen[kept]


def _drawing_order(rows: Surfaces, centre: Array) -> NDArray[np.int64]:
    """Shell, then decals, then the bodies far to near."""
    bodies = np.unique(rows.body[rows.body >= 0])
    rank = np.empty(len(rows.body_low) + 1, dtype=np.int64)
    rank[bodies[body_order(rows.body_low[bodies], rows.body_high[bodies], centre)]] = np.arange(len(bodies))
    place = np.where(rows.body >= 0, rank[np.maximum(rows.body, 0)], rows.body)
    return np.argsort(np.where(rows.body == SHELL, SHELL, place), kind="stable")


def body_order(low: Array, high: Array, centre: Array) -> NDArray[np.int64]:
    """An order of boxes (n, 3), (n, 3) in which none comes before one that it may hide from ``centre``.

    Where a plane separates two boxes, the one beyond it can't hide the one on the camera's side. Boxes
    that overlap go by distance, and a circle of boxes is opened at its farthest.
    """
    n = len(low)
    beyond_low = centre <= low  # the camera is on the low side of the box
    beyond_high = centre >= high
    slack = 1e-6
    higher = (low[:, None] >= high[None] - slack) & beyond_low[:, None]
    lower = (high[:, None] <= low[None] + slack) & beyond_high[:, None]
    hides = ~(higher | lower).any(axis=2)
    distance = np.linalg.norm((low + high) / 2 - centre, axis=1)
    equal = (distance[:, None] == distance[None]) & np.tri(n, dtype=bool)
    nearer = (distance[:, None] < distance[None]) | equal
    hides &= ~hides.T | nearer
    np.fill_diagonal(hides, False)
    waiting = hides.sum(axis=1)
    left = np.ones(n, dtype=bool)
    out: list[NDArray[np.int64]] = []
    while left.any():
        ready = np.flatnonzero(left & (waiting == 0))
        if not len(ready):
            ready = np.array([np.argmax(np.where(left, distance, -1.0))])
        out.append(ready)
        left[ready] = False
        waiting -= hides[:, ready].sum(axis=1)
    return np.concatenate(out) if out else np.zeros(0, dtype=np.int64)
