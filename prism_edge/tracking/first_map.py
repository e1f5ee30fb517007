"""The first map, checked against its second view."""

from __future__ import annotations

import logging
from enum import Enum

import numpy as np

from prism_edge.geometry.poses import transform
from prism_edge.tracking import mapping
from prism_edge.tracking.frame_tracking import TrackedFrame
from prism_edge.tracking.initialisation import MIN_POINTS
from prism_edge.tracking.local_map import NO_POINT, LocalKeyframe, LocalMap
from prism_edge.tracking.matching import match_corners
from prism_edge.tracking.second_look import two_views

log = logging.getLogger("prism_edge.tracking")

CAN_WAIT_MATCHES = 100
MISLED = 2  # times as many match by their looks as tracking finds: a pure turn, rightly tracked, reaches 1.75


class SecondView(Enum):
    """What the second view says of the first map."""

    TOO_NEAR = "wait for more parallax"
    AGREES = "the first map stands"
    CONTRADICTS = "the first map rests on two views now, and the motion until here was none"


def begin_structure(world: LocalMap, first: LocalKeyframe, frame: TrackedFrame, seed: int) -> SecondView:
    """Check what the network gave the first map against two views.

    Corners are matched by their looks alone: what tracking found, it found where wrong depths led it. Where
    the network's depths contradict the matches (outdoors, say), the two views' structure takes their place
    and ``frame`` is moved. A camera that is about to lose the first view can't wait for parallax.
    """
    table = world.points
    before, now = match_corners(first.features, frame.features)
    views, ids = two_views(world, first, frame, before, now, seed, MIN_POINTS)
    if views is None:
        misled = len(before) >= max(CAN_WAIT_MATCHES, MISLED * frame.matched)
        return SecondView.TOO_NEAR if misled or frame.matched >= CAN_WAIT_MATCHES else SecondView.AGREES
    if not views.contradicts:
        return SecondView.AGREES
    log.info("network depth scatters by %.2f: the first map rests on two views", views.depth_spread)
    frame.world_from_camera = first.world_from_camera @ views.first_from_second
    good = views.good & (ids != NO_POINT)
    rows = table.rows(ids[good])
    table.position[rows] = transform(first.world_from_camera, views.points[good])
    table.parallax_deg[rows] = np.degrees(views.parallax[good])
    sigma = mapping.MATCHING_SIGMA_PX / (frame.camera.fx * np.maximum(views.parallax[good], 1e-4))
    table.log_depth_sigma[rows] = np.minimum(sigma, 2.0)
    world.changes.new_points.append(table.ids[rows])
    frame.points[:] = NO_POINT
    frame.points[now[good]] = ids[good]
    kept = np.isin(table.ids, ids[good])
    world.cull_points(np.flatnonzero(table.alive & ~kept & (table.reference == first.id)))
    return SecondView.CONTRADICTS
