"""Whether two keyframes show one place: from matched corners to a pose that the map's points agree with.

Paper, section 3.5: Essential-matrix RANSAC on the corners of both, perspective-n-point on the map's points,
then points of the candidate's whole surroundings looked for where that pose expects them. A place that only
looks the same fails one of these, or the check by the query's neighbours, or asks for more drift than the way
between can have brought (:func:`plausible`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from prism_edge.backend.connectivity import Way, own_way
from prism_edge.backend.free_points import placed
from prism_edge.backend.global_map import GlobalKeyframe, GlobalMap
from prism_edge.geometry.field_of_view import in_image
from prism_edge.geometry.poses import Array, inverse, normalised, rotation_angle, scaled, transform
from prism_edge.tracking.depth_alignment import robust_sigma
from prism_edge.tracking.matching import match_corners, match_projected
from prism_edge.tracking.perspective_pose import perspective_pose
from prism_edge.tracking.point_table import Index
from prism_edge.tracking.pose_refinement import refine_pose

MIN_MATCHES, MIN_EPIPOLAR, MIN_PNP = 20, 15, 10
EPIPOLAR_PX, PNP_PX = 2.0, 5.0
EPIPOLAR_TRIES = 300
SURROUNDINGS = 8  # keyframes beside the candidate whose points are looked for
GUIDED_DISTANCE, GUIDED_RATIO = 64, 0.9
GUIDED_RADII = (14.0, 7.0)  # pixels at the finest level
DRIFT_RADIUS = 28.0
MIN_EXPECTED = 30  # of the candidate's points in the query's image: else the map's pose is not worth a try
AS_WELL = 0.8  # of what agrees with a pose: another with so much of it is as good
HELD = 10  # of the candidate's points that the query sees where the map has it: it can't be elsewhere too
NEIGHBOURS, NEIGHBOUR_INLIERS = 4, 15  # keyframes beside the query that must see the place too
NEIGHBOUR_ANGLE, NEIGHBOUR_SHIFT = np.radians(3.0), 0.1  # how far they may disagree; of the median depth
MIN_FRESH = 10  # points that the query did not know: else nothing would be closed
MIN_SCALED = 10  # points seen from both ends that tell the ratio of their units
DRIFT_SHARE, DRIFT_DEPTHS = 0.15, 0.3  # of the way between; of the median depth
SHORT_SHARE, SHORT_DEPTHS = 0.5, 0.05  # a short way has not been for nothing: steps look alike one on
# And of turns: what the camera turned by on the way goes wrong by the share that a focal length or an unsaid
# rolling shutter is off by.
TURN_DRIFT, TURN_DRIFT_PER_DEPTH, TURN_SHARE = np.radians(10.0), np.radians(0.5), 0.05


@dataclass(frozen=True)
class Loop:
    """Two keyframes that see one place. Lengths are in the unit of the candidate's end."""

    query: int
    candidate: int
    world_from_query: Array  # (4, 4) where the candidate's end of the map has the query
    scale: float  # of the candidate's unit in the query's: a length there times this is one here
    log_scale_sigma: float
    inliers: int
    neighbours: int  # keyframes beside the query that agree
    pairs: list[tuple[int, int]] = field(repr=False)  # keypoint of the query, point of the candidate's end
    # (6, 6) of world_from_query, translation first, in the query's frame, where it was asked for.
    information: Array | None = field(default=None, repr=False)


def verify(
    world: GlobalMap, query: int, candidate: int, least: int, seed: int = 0, blindly: bool = True
) -> Loop | None:
    """The loop between two keyframes, at least ``least`` points agreeing; None where there is none.

    Without ``blindly`` it is looked for only where the map's own pose leads.
    """
    here, there = world.keyframes[query], world.keyframes[candidate]
    pose = _first_pose(world, here, there, seed) if blindly else None
    expected = _expected(world, here, there)
    if pose is None and expected < MIN_EXPECTED:
        return None
    surroundings, found = Surroundings(world, candidate, without=query), None
    if pose is not None:
        found = surroundings.look(here, pose, GUIDED_RADII)
    if expected >= MIN_EXPECTED:
        # Seen from far aside few corners match blindly; where drift is small, the map's own pose leads there.
        # And steps or windows look alike one on: what agrees nearly as well where the map has it is right.
        own = surroundings.look(here, here.world_from_camera, (DRIFT_RADIUS, *GUIDED_RADII))
        found = _likelier(world, here, found, own, least)
    if found is None or len(found.keypoints) < least:
        return None
    pairs = list(zip(found.keypoints.tolist(), found.points.tolist(), strict=True))
    if sum(point not in here.observed for _, point in pairs) < MIN_FRESH:
        return None
    its = np.array([world.points[p].position for _, p in pairs])
    scale, sigma = _unit_ratio(world, here, found.world_from_camera, pairs, its)
    agreeing = _agreeing_neighbours(world, surroundings, here, found.world_from_camera, scale)
    return Loop(query, candidate, found.world_from_camera, scale, sigma, len(pairs), agreeing, pairs)


def _likelier(
    world: GlobalMap, here: GlobalKeyframe, blind: Found | None, own: Found | None, least: int
) -> Found | None:
    """What was found blindly; or from the map's own pose, where that is another place and as good.

    Few points are enough for that where the view holds on to them already: tracking has found them where the
    map has them, so there is no drift to take out, however much agrees a step aside.
    """
    if blind is None or len(blind.keypoints) < least:
        return own
    if own is None or _agree(own.world_from_camera, blind.world_from_camera, median_depth(world, here)):
        return blind
    held = sum(point in here.observed for point in own.points.tolist())
    as_good = len(own.keypoints) >= max(float(least), AS_WELL * len(blind.keypoints))
    return own if as_good or held >= HELD else blind


def _agree(one: Array, other: Array, depth: float) -> bool:
    """Whether two poses (4, 4) of a view are as good as the same; ``depth``: of what it sees."""
    off = inverse(one) @ other
    near = float(np.linalg.norm(off[:3, 3])) < NEIGHBOUR_SHIFT * depth
    return near and rotation_angle(off[:3, :3]) < NEIGHBOUR_ANGLE


def plausible(world: GlobalMap, loop: Loop, shortest: Way | None) -> bool:
    """Whether drift along the way from candidate to query can be as large as the loop says.

    The way is the camera's own, or the ``shortest`` by keyframes that hold on to each other where that is
    shorter, or turns less: its own grows without end where it only stands and looks about.
    """
    query = world.keyframes[loop.query]
    own = own_way(world, loop.candidate, loop.query)
    length, turned = own if shortest is None else map(min, own, shortest)
    depth = median_depth(world, query)
    motion = inverse(query.world_from_camera) @ loop.world_from_query
    shift = float(np.linalg.norm(query.world_from_camera[:3, 3] - loop.world_from_query[:3, 3]))
    most_turn = TURN_DRIFT + TURN_DRIFT_PER_DEPTH * length / max(depth, 1e-9) + TURN_SHARE * turned
    most_shift = min(
        DRIFT_SHARE * length + DRIFT_DEPTHS * depth, SHORT_SHARE * length + SHORT_DEPTHS * depth
    )
    return shift <= most_shift and rotation_angle(motion[:3, :3]) <= most_turn


def median_depth(world: GlobalMap, keyframe: GlobalKeyframe) -> float:
    """Median depth of what a keyframe sees; 1 where it sees nothing."""
    if not keyframe.observed:
        return 1.0
    places = np.array([world.points[p].position for p in keyframe.observed])
    depth = float(np.median(transform(inverse(keyframe.world_from_camera), places)[:, 2]))
    return depth if depth > 0 else 1.0


def _expected(world: GlobalMap, here: GlobalKeyframe, there: GlobalKeyframe) -> int:
    """How many points of one keyframe the map expects in the image of another."""
    if not there.observed:
        return 0
    local = transform(
        inverse(here.world_from_camera), np.array([world.points[p].position for p in there.observed])
    )
    local = local[local[:, 2] > 1e-3]
    return int(in_image(here.camera, here.camera.ideal().project(local)).sum())


@dataclass(frozen=True)
class Found:
    """A view placed among points: which keypoint shows which point."""

    world_from_camera: Array
    keypoints: Index
    points: NDArray[np.int64]


class Surroundings:
    """The points of a keyframe and of those that see the same, as its end of a loop knows them."""

    def __init__(self, world: GlobalMap, keyframe: int, without: int) -> None:
        near = [k for k in world.neighbours(keyframe) if k != without]
        self.keyframes = [keyframe, *near[:SURROUNDINGS]]
        seen: dict[int, tuple[int, int]] = {}
        for k in self.keyframes:
            for point, keypoint in world.keyframes[k].observed.items():
                seen.setdefault(point, (k, keypoint))
        views = [world.keyframes[k] for k, _ in seen.values()]
        rows = [keypoint for _, keypoint in seen.values()]
        self.points = np.array(list(seen), np.int64)
        self.positions = np.array([world.points[p].position for p in seen]).reshape(-1, 3)
        pairs = list(zip(views, rows, strict=True))
        self.descriptors = np.array([v.features.descriptors[i] for v, i in pairs], np.uint64).reshape(-1, 4)
        self.octaves = np.array([v.features.octaves[i] for v, i in pairs], np.intp)
        centres = np.array([v.world_from_camera[:3, 3] for v in views]).reshape(-1, 3)
        self.distances = np.linalg.norm(self.positions - centres, axis=1)
        self.directions = (centres - self.positions) / np.maximum(self.distances, 1e-9)[:, None]

    def look(self, view: GlobalKeyframe, start: Array, radii: tuple[float, ...]) -> Found | None:
        """Look for the points where ``start`` (world_from_camera) expects them in a view, then refine it."""
        pose = start
        for radius in radii:
            query, keypoint = self._match(view, pose, radius)
            if len(query) < 6:
                return None
            estimate = refine_pose(
                view.camera, pose, self.positions[query], view.pixels[keypoint], view.sigmas[keypoint]
            )
            pose = normalised(estimate.world_from_camera)
            found = Found(pose, keypoint[estimate.inliers], self.points[query[estimate.inliers]])
        return found

    def _match(self, view: GlobalKeyframe, pose: Array, radius: float) -> tuple[Index, Index]:
        local = transform(inverse(pose), self.positions)
        front = np.flatnonzero(local[:, 2] > 1e-3)
        pixels = view.camera.ideal().project(local[front])
        inside = in_image(view.camera, pixels)
        rows, pixels = front[inside], pixels[inside]
        offset = pose[:3, 3] - self.positions[rows]
        distance = np.maximum(np.linalg.norm(offset, axis=1), 1e-9)
        nearer = np.log(self.distances[rows] / distance) / np.log(view.scale_factor)
        octave = self.octaves[rows] + np.rint(nearer)
        # Seen from far aside, or far larger or smaller than then, a corner does not look the same.
        same = np.einsum("ij,ij->i", offset, self.directions[rows]) > 0.5 * distance
        same &= np.abs(octave - self.octaves[rows]) <= 4
        rows, pixels, octave = rows[same], pixels[same], np.maximum(octave[same], 0).astype(np.intp)
        query, keypoint = match_projected(
            view.features,
            pixels,
            radius * view.scale_factor**octave,
            octave,
            self.descriptors[rows],
            GUIDED_DISTANCE,
            GUIDED_RATIO,
        )
        return rows[query], keypoint


def _first_pose(
    world: GlobalMap, here: GlobalKeyframe, there: GlobalKeyframe, seed: int
) -> Array | None:
    """world_from_query by corners that fit one epipolar geometry and points that fit one pose."""
    mine, its = match_corners(here.features, there.features)
    if len(mine) < MIN_MATCHES:
        return None
    # Both in the query's camera, so that one calibration serves two cameras.
    calibration = here.camera.matrix
    its_pixels = here.camera.to_pixels(there.camera.on_plane(there.pixels[its]))
    cv2.setRNGSeed(seed)
    try:
        essential, mask = cv2.findEssentialMat(
            its_pixels,
            here.pixels[mine],
            calibration,
            method=cv2.USAC_FAST,  # a thirtieth of plain RANSAC's time where nothing matches
            prob=0.999,
            threshold=EPIPOLAR_PX,
            maxIters=EPIPOLAR_TRIES,
        )
    except cv2.error:
        return None  # degenerate: all on one spot, say
    if essential is None or mask is None or mask.sum() < MIN_EPIPOLAR:
        return None
    fits = mask.ravel().astype(bool)
    point_of = {keypoint: point for point, keypoint in there.observed.items()}
    matches = zip(mine[fits].tolist(), its[fits].tolist(), strict=True)
    pairs = [(i, point_of[j]) for i, j in matches if j in point_of]
    if len(pairs) < MIN_PNP:
        return None
    positions = np.array([world.points[p].position for _, p in pairs])
    pixels = here.pixels[[i for i, _ in pairs]]
    return perspective_pose(positions, pixels, calibration, PNP_PX, 0.999, MIN_PNP)


def with_free_points(world: GlobalMap, loop: Loop) -> Loop:
    """The loop as it is where its points' depths may be wrong, and how sure it is then."""
    query = world.keyframes[loop.query]
    found = placed(world, query, loop.pairs, [loop.world_from_query, query.world_from_camera])
    if found is None:
        return loop
    pose = found.world_from_query
    scale, sigma = _unit_ratio(world, query, pose, loop.pairs, found.places)
    sigma = math.hypot(sigma, found.depth_sigma())
    return replace(
        loop, world_from_query=pose, information=found.information, scale=scale, log_scale_sigma=sigma
    )


def _unit_ratio(
    world: GlobalMap, here: GlobalKeyframe, world_from_query: Array, pairs: list[tuple[int, int]], its: Array
) -> tuple[float, float]:
    """How long the candidate's end finds what the query's end calls 1, and the sigma of its logarithm.

    From points that both ends know: their depths in the query's camera by its own points and by the others,
    which are at ``its`` (pairs, 3).
    """
    own = {keypoint: point for point, keypoint in here.observed.items()}
    both = [n for n, (i, p) in enumerate(pairs) if i in own and own[i] != p]
    if len(both) < MIN_SCALED:
        return 1.0, 0.2
    mine = np.array([world.points[own[pairs[n][0]]].position for n in both])
    depth = transform(inverse(here.world_from_camera), mine)[:, 2]
    its_depth = transform(inverse(world_from_query), its[both])[:, 2]
    good = (depth > 1e-6) & (its_depth > 1e-6)
    if good.sum() < MIN_SCALED:
        return 1.0, 0.2
    ratios = np.log(its_depth[good] / depth[good])
    return float(np.exp(np.median(ratios))), max(1.25 * robust_sigma(ratios) / np.sqrt(good.sum()), 0.002)


def _agreeing_neighbours(
    world: GlobalMap, surroundings: Surroundings, here: GlobalKeyframe, pose: Array, scale: float
) -> int:
    """How many keyframes beside the query see the same place from where the loop then puts them."""
    agreeing = 0
    inside = set(surroundings.keyframes)
    near = [k for k in world.neighbours(here.id) if k not in inside]
    for k in near[:NEIGHBOURS]:
        view = world.keyframes[k]
        expected = pose @ scaled(inverse(here.world_from_camera) @ view.world_from_camera, scale)
        found = surroundings.look(view, expected, GUIDED_RADII)
        if found is None or len(found.keypoints) < NEIGHBOUR_INLIERS:
            continue
        agreeing += _agree(expected, found.world_from_camera, scale * median_depth(world, view))
    return agreeing
