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
        for origin, right, down in zip(one.origin, one.right, one.down, strict=True):
            normal = np.cross(down, right)
            along = rays @ normal
            with np.errstate(divide="ignore", invalid="ignore"):
                reach = ((origin - centre) @ normal) / along
                hit = centre + reach[:, None] * rays - origin
                a, b = hit @ right / (right @ right), hit @ down / (down @ down)
            inside = (along < 0) & (reach > 0) & (a >= 0) & (a <= 1) & (b >= 0) & (b <= 1)
            nearest = np.where(inside & (reach < nearest), reach, nearest)
    return nearest
