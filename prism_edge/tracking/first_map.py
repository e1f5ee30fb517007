"""The first map, checked against its second view."""

from __future__ import annotations

import logging
from enum import Enum

import numpy as np

from prism_edge.geometry.poses import inverse, transform
from prism_edge.tracking import mapping
from prism_edge.tracking.frame_tracking import TrackedFrame
from prism_edge.tracking.initialisation import reconstruct
from prism_edge.tracking.local_map import LocalKeyframe, LocalMap

log = logging.getLogger("prism_edge.tracking")

CAN_WAIT_MATCHES = 100


class SecondView(Enum):
    """What the second view says of the first map."""

    TOO_NEAR = "wait for more parallax"
    AGREES = "the first map stands"
    CONTRADICTS = "the first map rests on two views now, and the motion until here was none"


def begin_structure(world: LocalMap, first: LocalKeyframe, frame: TrackedFrame, seed: int) -> SecondView:
    """Check what the network gave the first map against two views.

    Where its depths contradict the matches (outdoors, say), the two views' structure takes their place and
    ``frame`` is moved. A camera that is about to lose the first view can't wait for parallax.
    """
    table = world.points
    keypoints = np.flatnonzero(frame.points >= 0)
    rows = table.rows(frame.points[keypoints])
    depths = (table.position[rows] - first.world_from_camera[:3, 3]) @ first.world_from_camera[:3, 2]
    views = reconstruct(
        frame.camera,
        first.features.pixels[table.reference_keypoint[rows]],
        frame.features.pixels[keypoints],
        depths,
        inverse(first.world_from_camera) @ frame.world_from_camera,
        seed,
    )
    if views is None:
        return SecondView.AGREES if frame.matched < CAN_WAIT_MATCHES else SecondView.TOO_NEAR
    if not views.contradicts:
        return SecondView.AGREES
    log.info("network depth scatters by %.2f: the first map rests on two views", views.depth_spread)
    frame.world_from_camera = first.world_from_camera @ views.first_from_second
    good = views.good
    table.position[rows[good]] = transform(first.world_from_camera, views.points[good])
    table.parallax_deg[rows[good]] = np.degrees(views.parallax[good])
    sigma = mapping.MATCHING_SIGMA_PX / (frame.camera.fx * np.maximum(views.parallax[good], 1e-4))
    table.log_depth_sigma[rows[good]] = np.minimum(sigma, 2.0)
    world.changes.new_points.append(table.ids[rows[good]])
    frame.points[keypoints[~good]] = -1
    kept = np.isin(table.ids, table.ids[rows[good]])
    world.cull_points(np.flatnonzero(table.alive & ~kept & (table.reference == first.id)))
    return SecondView.CONTRADICTS
