"""People of boxes who walk to and fro on their lanes, swinging arms and legs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from prism_edge.geometry.poses import Array
from prism_edge.messages import U8
from prism_edge.sources.sim import pictures
from prism_edge.sources.sim.floorplan import Lane
from prism_edge.sources.sim.surfaces import Shop, Surfaces
from prism_edge.sources.sim.textures import cloth, colour, plain, wood

_SWING = 0.13  # m that a foot or hand goes ahead and back


@dataclass(frozen=True)
class Walker:
    """One person: surfaces in the person's frame (x ahead, z up), how far each swings, and the way walked."""

    lane: Lane
    surfaces: Surfaces
    swing: Array  # (bodies,) m along x at the height of a stride
    pace: float  # m/s in the middle of the lane
    phase: float

    @classmethod
    def random(cls, rng: np.random.Generator, lane: Lane, textures: list[U8]) -> Walker:
        """Someone of random build and dress; their textures are appended to ``textures``."""
        shop = Shop(rng, textures)
        tall = float(rng.uniform(1.58, 1.9))
        first, second = (
            colour(rng.random(), rng.uniform(0.05, 0.55), rng.uniform(0.2, 0.75)) for _ in range(2)
        )
        shirt = cloth(first, second, int(rng.integers(3)))
        trousers = cloth(colour(rng.uniform(0.5, 0.7), 0.4, rng.uniform(0.15, 0.6)), second, 0)
        skin = plain(colour(0.06, rng.uniform(0.3, 0.55), rng.uniform(0.5, 0.95)))
        hair = wood(colour(rng.uniform(0.02, 0.12), 0.6, rng.uniform(0.1, 0.6)), contrast=0.25)
        hip, neck = 0.5 * tall, 0.84 * tall
        swing = []
        for side in (-1.0, 1.0):
            limb = dict.fromkeys(("front", "back", "side", "top"), trousers)
            shop.add_box(np.array([0.0, 0.1 * side, hip / 2]), np.array([0.16, 0.15, hip]), 0.0, limb)
            swing.append(_SWING * side)
        for side in (-1.0, 1.0):
            limb = dict.fromkeys(("front", "back", "side", "top", "bottom"), shirt)
            middle = np.array([0.0, 0.285 * side, (hip + neck) / 2])
            shop.add_box(middle, np.array([0.1, 0.09, neck - hip]), 0.0, limb)
            swing.append(-0.6 * _SWING * side)
        torso = dict.fromkeys(("front", "back", "side", "top", "bottom"), shirt)
        shop.add_box(
            np.array([0.0, 0.0, (hip + neck) / 2 + 0.001]), np.array([0.24, 0.46, neck - hip]), 0.0, torso
        )
        looks = {"front": skin, "back": skin, "top": hair, "bottom": skin}
        size = np.array([0.2, 0.17, tall - neck - 0.003])
        head = np.array([0.0, 0.0, (tall + neck) / 2 + 0.002])
        shop.add_box(head, size, 0.0, looks, 300.0)
        body = len(swing) + 1
        for sign, paint in ((1.0, pictures.face), (-1.0, hair)):
            across = np.array([0.0, sign * size[1], 0.0])
            corner = head + np.array([sign * size[0] / 2, 0.0, size[2] / 2]) - across / 2
            shop.add(corner, across, np.array([0.0, 0.0, -size[2]]), paint, 300.0, body)
        swing += [0.0, 0.0]
        return cls(
            lane, shop.done(), np.array(swing), float(rng.uniform(0.6, 1.0)), float(rng.uniform(0, 2 * np.pi))
        )

    def where(self, seconds: float) -> tuple[Array, float, float]:
        """Position on the floor (2,), yaw (rad), and metres walked, at a time."""
        way = self.lane.end - self.lane.start
        length = float(np.linalg.norm(way))
        # There and back as a cosine: slow at the ends, where the walker turns round.
        angle = 2 * self.pace / length * seconds + self.phase
        position = self.lane.start + way * (0.5 - 0.5 * np.cos(angle))
        turned = 0.5 - 0.5 * np.tanh(6.0 * np.sin(angle)) / np.tanh(6.0)
        walked = 0.5 * length * float(-np.cos(angle))
        return position, float(np.arctan2(way[1], way[0]) + np.pi * turned), walked

    def at(self, seconds: float) -> Surfaces:
        """The person's surfaces in the world at a time."""
        position, yaw, walked = self.where(seconds)
        c, s = np.cos(yaw), np.sin(yaw)
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        own = self.surfaces
        ahead = self.swing * np.sin(2 * np.pi * walked / 1.3)
        place = np.array([*position, 0.0])
        shifted = own.origin + np.stack([ahead[own.body], *np.zeros((2, len(own.body)))], axis=1)
        middle = (own.body_low + own.body_high) / 2 + np.stack([ahead, *np.zeros((2, len(ahead)))], axis=1)
        reach = (own.body_high - own.body_low) / 2 @ np.abs(turn).T
        middle = middle @ turn.T + place
        return Surfaces(
            shifted @ turn.T + place,
            own.right @ turn.T,
            own.down @ turn.T,
            own.normal @ turn.T,
            own.texture,
            own.body,
            middle - reach,
            middle + reach,
        )


def walkers_at(walkers: list[Walker], seconds: float) -> dict[int, Surfaces]:
    """Everybody's surfaces by the room they walk in, at a time."""
    out: dict[int, Surfaces] = {}
    for walker in walkers:
        moving = walker.at(seconds)
        other = out.get(walker.lane.room)
        out[walker.lane.room] = moving if other is None else other.joined(moving)
    return out
