"""Depth found the slow way, as an independent check: each ray against each rectangle of the world."""

from __future__ import annotations

import numpy as np

from prism_edge.geometry.poses import Array
from prism_edge.sources.sim import SimSource
from prism_edge.sources.sim.actors import walkers_at
from prism_edge.sources.sim.surfaces import Surfaces


def all_surfaces(source: SimSource, index: int) -> list[Surfaces]:
    """The surfaces of every cell, and of the people where they are at a frame."""
    renderer, _ = source._opened()
    moving = walkers_at(source._walkers, source.stamp_ns(index) * 1e-9)
    return [cell.surfaces for cell in renderer.world.cells] + list(moving.values())


def cast(surfaces: list[Surfaces], centre: Array, rays: Array) -> Array:
    """How many lengths of each ray (n, 3) from ``centre`` it is to the first rectangle that faces it."""
    nearest = np.full(len(rays), np.inf)
    for one in surfaces:
        along = rays @ np.cross(one.down, one.right).T  # (rays, rectangles)
        offset = one.origin - centre
        with np.errstate(divide="ignore", invalid="ignore"):
            reach = np.sum(offset * np.cross(one.down, one.right), axis=1) / along
            inside = (along < 0) & (reach > 0)
            for edge in (one.right, one.down):
                share = reach * (rays @ edge.T) - np.sum(offset * edge, axis=1)
                inside &= (share >= 0) & (share <= np.sum(edge * edge, axis=1))
        nearest = np.minimum(nearest, np.where(inside, reach, np.inf).min(axis=1))
    return nearest


def agreement(source: SimSource, indices: tuple[int, ...]) -> float:
    """Share of random pixels of some frames whose depth is what casting rays finds; all rays must end."""
    rng, near = np.random.default_rng(0), []
    camera = source.camera
    for index in indices:
        pose, depth = source.pose(index), source.depth(index)
        pixels = rng.integers((0, 0), (camera.width, camera.height), (200, 2))
        rays = np.column_stack([(pixels - [camera.cx, camera.cy]) / camera.fx, np.ones(200)])
        found = cast(all_surfaces(source, index), pose[:3, 3], rays @ pose[:3, :3].T)
        assert np.isfinite(found).all()
        near.append(np.abs(depth[pixels[:, 1], pixels[:, 0]] / found - 1.0) < 0.005)
    return float(np.mean(near))
