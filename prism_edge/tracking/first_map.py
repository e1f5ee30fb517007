"""The first map, checked against its second view."""

from __future__ import annotations

import logging
from enum import Enum

import numpy as np

from prism_edge.geometry.poses import inverse, transform
from prism_edge.tracking import mapping
from prism_edge.tracking.frame_tracking import TrackedFrame
from prism_edge.tracking.initialisation import MIN_POINTS
from prism_edge.tracking.local_map import NO_POINT, LocalKeyframe, LocalMap
from prism_edge.tracking.matching import match_corners
from prism_edge.tracking.point_table import Index
from prism_edge.tracking.second_look import two_views
from prism_edge.tracking.triangulation import rays
from prism_edge.tracking.two_view_pose import lead_apart

log = logging.getLogger("prism_edge.tracking")

CAN_WAIT_MATCHES = 100
MISLED = 2  # times as many match by their looks as tracking finds
APART = np.radians(60.0)  # between two ways that the matches allow: which is true is not decided yet
LEAST_SHARE = 0.65  # of the corners fit two views that unseat the network; what moves has fewer agree
TURNED = np.radians(1.0)  # so near to where a turn alone takes it a corner says nothing against the turn
CHANCE = np.radians(10.0)  # where it is farther off its match is one by chance, if the turn is right


class SecondView(Enum):
    """What the second view says of the first map."""

    TOO_NEAR = "wait for more parallax"
    AGREES = "the first map stands"
    CONTRADICTS = "the first map rests on two views now, and the motion until here was none"


def begin_structure(world: LocalMap, first: LocalKeyframe, frame: TrackedFrame, seed: int) -> SecondView:
    """Check what the network gave the first map against two views.

    Corners are matched by their looks alone: what tracking found, it found where wrong depths led it. Where
    the network's depths contradict the matches (outdoors, say), the two views' structure takes their place
    and ``frame`` is moved, if most corners fit that: past a camera that stands, what moves looks like its
    motion. Where they would allow both ways, a camera waits for more parallax, unless it is about to lose
    the first view.
    """
    table = world.points
    before, now = match_corners(first.features, frame.features)
    views, ids = two_views(world, first, frame, before, now, seed, MIN_POINTS)
    can_wait = frame.matched >= CAN_WAIT_MATCHES
    if views is None:
        wait = can_wait or _is_misled(first, frame, before, now)
        return SecondView.TOO_NEAR if wait else SecondView.AGREES
    if not views.contradicts or views.good.mean() < LEAST_SHARE:
        # Under little parallax a turn one way and a step the other look alike, near and far exchanged.
        tracked = inverse(first.world_from_camera) @ frame.world_from_camera
        wait = can_wait and lead_apart(tracked, views.first_from_second, APART)
        return SecondView.TOO_NEAR if wait else SecondView.AGREES
    log.info("network depth scatters by %.2f: the first map rests on two views", views.depth_spread)
    frame.world_from_camera = first.world_from_camera @ views.first_from_second
    good = views.good & (ids != NO_POINT)
    rows = table.rows(ids[good])
    table.position[rows] = transform(first.world_from_camera, views.points[good])
    table.parallax_deg[rows] = np.degrees(views.parallax[good])
    sigma = mapping.depth_sigma(frame.camera.fx, np.maximum(views.parallax[good], 1e-4))
    table.log_depth_sigma[rows] = np.minimum(sigma, 2.0)
    world.changes.new_points.append(table.ids[rows])
    frame.points[:] = NO_POINT
    frame.points[now[good]] = ids[good]
    kept = np.isin(table.ids, ids[good])
    world.cull_points(np.flatnonzero(table.alive & ~kept & (table.reference == first.id)))
    return SecondView.CONTRADICTS


def _is_misled(first: LocalKeyframe, frame: TrackedFrame, before: Index, now: Index) -> bool:
    """Whether many more corners match by their looks than tracking finds, and not where it has turned them.

    In a large image thousands match, and the first map has a few hundred points: that alone says nothing.
    Nor does a hundred of them that match by chance, anywhere in the image.
    """
    turn = (inverse(first.world_from_camera) @ frame.world_from_camera)[:3, :3]
    expected = rays(first.camera, first.features.pixels[before]) @ turn
    seen = rays(frame.camera, frame.features.pixels[now])
    across = np.linalg.norm(np.cross(expected, seen), axis=1)
    angle = np.arctan2(across, np.einsum("ij,ij->i", expected, seen))
    elsewhere = angle > TURNED
    if np.count_nonzero(elsewhere) <= len(elsewhere) / 2:
        elsewhere &= angle < CHANCE
    enough = len(before) >= MISLED * frame.matched
    return bool(enough and np.count_nonzero(elsewhere) >= CAN_WAIT_MATCHES)
