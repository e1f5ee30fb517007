"""One frame against the local map: match where the motion model expects points, refine the pose."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from prism_edge.geometry.cameras import Camera
from prism_edge.geometry.poses import Array
from prism_edge.tracking.baseline import best_parallax, unobserved_translation
from prism_edge.tracking.features import Features
from prism_edge.tracking.local_map import LocalKeyframe, LocalMap
from prism_edge.tracking.matching import match_projected
from prism_edge.tracking.motion import Prediction
from prism_edge.tracking.point_table import Ids, Index
from prism_edge.tracking.point_trust import proven
from prism_edge.tracking.pose_from_map import SEED_SIGMA, Centres, PoseFromMap
from prism_edge.tracking.pose_refinement import PoseEstimate
from prism_edge.tracking.projection import expected_octaves, project
from prism_edge.tracking.view import View

# Hamming distances of 256: the same corner seen again stays well below, another one is near 128.
MOTION_DISTANCE, MOTION_RATIO = 64, 0.9
LOCAL_DISTANCE, LOCAL_RATIO = 72, 0.8
SEARCH_RADII = (15.0, 40.0, 80.0)  # pixels at level 0, tried in turn when too little is found
LOCAL_RADIUS, SEED_RADIUS = 3.0, 6.0
MIN_VIEW_COSINE = 0.5
LOCAL_KEYFRAMES = 60
# Points of the previous frame that give the first pose; keypoints come best of each cell first.
FIRST_POSE_POINTS = 150
# Rounds of the solver, and steps in each. The second pose starts so near its end that a step is enough, and
# one more choice of inliers brings it nearer to where many rounds would than further steps do.
FIRST_POSE_ROUNDS, POSE_ROUNDS = (1, 2), (3, 1)
SUDDEN_LOSS = 0.65  # of the previous frame's matches


@dataclass
class TrackedFrame:
    """A frame placed in the map."""

    camera: Camera
    features: Features
    world_from_camera: Array
    points: Ids  # map point of each keypoint, -1 for none; inliers only
    covariance: Array  # (6, 6), translation first, camera frame, map units
    matched: int
    unobserved: float = 0.0  # standard deviation of the position beside the covariance, map units
    parallax_deg: float = 1.0  # that its best points were placed under (baseline.py)
    expected: Prediction | None = None  # what the pose was solved with beside its points
    taken_ns: int = 0  # stamp; 0: not later than the newest keyframe's

    @classmethod
    def of_keyframe(cls, keyframe: LocalKeyframe, matched: int) -> TrackedFrame:
        """A keyframe as the frame that tracking goes on from."""
        pose, points = keyframe.world_from_camera.copy(), keyframe.points.copy()
        return cls(keyframe.camera, keyframe.features, pose, points, np.zeros((6, 6)), matched)


class FrameTracker:
    """Places frames in a local map."""

    def __init__(self, scale_factors: Array, max_local_points: int, proven_after_s: float = 0.0) -> None:
        self._factors = scale_factors
        self.pose = PoseFromMap(scale_factors, proven_after_s)
        self.expected: Prediction | None = None  # of the frame at hand
        self.learns = True  # of points how often they are found: not from places where the camera may not be
        self._most = max_local_points
        self._local_ids: Ids = np.zeros(0, np.int64)

    def refresh_local_map(self, world: LocalMap, point_ids: Ids) -> None:
        """Choose the points to look for: those of the keyframes that share most with what is seen.

        Where keyframes stand close, a dozen of them reach back a second or two: what is older would be mapped
        a second time, and the map would drift within itself.
        """
        known = point_ids.compress(world.points.known(point_ids))
        ranked = sorted(world.votes(known).items(), key=lambda item: (-item[1], -item[0]))
        rows = world.rows_seen_by([world.keyframes[k] for k, _ in ranked[:LOCAL_KEYFRAMES]], self._most)
        self._local_ids = world.points.ids[rows].copy()

    def track_after(
        self,
        world: LocalMap,
        view: View,
        moving: Array,
        previous: TrackedFrame,
        enough: int,
    ) -> TrackedFrame | None:
        """Place a frame where ``moving`` predicts it; None where too little agrees.

        One that suddenly matches far less may have followed a wrong prediction: it is tried where the
        ``previous`` was, too.
        """
        best: TrackedFrame | None = None
        for predicted in (moving, previous.world_from_camera):
            tried = self.track(world, view, predicted, previous, enough)
            if tried is not None and (best is None or tried.matched > best.matched):
                best = tried
            if best is not None and best.matched > SUDDEN_LOSS * previous.matched:
                break
        return best

    def track(
        self,
        world: LocalMap,
        view: View,
        predicted: Array,
        previous: TrackedFrame | None,
        enough: int,
    ) -> TrackedFrame | None:
        """Place a frame near ``predicted`` (world_from_camera); None where too little agrees."""
        centres = world.centres()  # once for all solutions
        estimate, points = self._follow(world, centres, view, predicted, previous, enough)
        if estimate is None:
            return None
        table = world.points
        wanted = table.alive.copy()
        wanted[table.rows(points.compress(points >= 0))] = False
        local = table.live_rows(self._local_ids)
        local = local.compress(wanted.take(local))
        self._extend(world, view, estimate.world_from_camera, local, points)
        final = self._solve(world, centres, view, estimate.world_from_camera, points)
        if final is None:
            return None
        estimate, keypoints = final
        rows = world.points.rows(points.take(keypoints)).compress(estimate.inliers)
        if self.learns:
            world.points.found[rows] += 1
        points[keypoints.compress(~estimate.inliers)] = -1
        return TrackedFrame(
            view.camera,
            view.features,
            estimate.world_from_camera,
            points,
            estimate.covariance,
            len(rows),
            unobserved_translation(world, estimate.world_from_camera, rows),
            best_parallax(world.points, rows, view.camera.fx),
            self.expected,
            view.taken_ns,
        )

    def proven(self, world: LocalMap, rows: Index, taken_ns: int) -> NDArray[np.bool_]:
        """Which points (n,) have stood their time, for a frame that was taken then."""
        return proven(world.points, rows, self.pose.now(world, taken_ns), self.pose.proven_after_s)

    def usually_found(self, world: LocalMap, frame: TrackedFrame) -> float:
        """How many points of the local map are found from where a frame is, each as often as ever."""
        table = world.points
        rows = table.live_rows(self._local_ids)
        rows, _, _ = self._in_sight(world, frame.camera, frame.world_from_camera, rows)
        return float((table.found.take(rows) / np.maximum(table.visible.take(rows), 1)).sum())

    def placed_anew(self, world: LocalMap, frame: TrackedFrame, pose: Array, points: Ids) -> TrackedFrame:
        """The frame at a pose that was found otherwise, as sure as all its ``points`` make it just there.

        What was expected of the frame counts no more.
        """
        self.expected = None
        keypoints = np.flatnonzero(points >= 0)
        rows = world.points.rows(points[keypoints])
        view = View(frame.camera, frame.features, frame.taken_ns)
        estimate = self.pose.estimate(world, view, pose, rows, keypoints, (1, 0))
        unobserved = unobserved_translation(world, pose, rows)
        return replace(
            frame, world_from_camera=pose, points=points, matched=len(keypoints),
            covariance=estimate.covariance, unobserved=unobserved,
            parallax_deg=best_parallax(world.points, rows, frame.camera.fx), expected=None,
        )

    def seen_again(self, world: LocalMap, frame: TrackedFrame, view: View) -> TrackedFrame:
        """The frame with its keypoints elsewhere (``view``, in the same order), placed anew by them."""
        start, points = frame.world_from_camera, frame.points.copy()
        solved = self._solve(world, world.centres(), view, start, points)
        if solved is None:
            return frame
        estimate, keypoints = solved
        points[keypoints[~estimate.inliers]] = -1
        return replace(
            frame, features=view.features, world_from_camera=estimate.world_from_camera, points=points,
            covariance=estimate.covariance, matched=int(estimate.inliers.sum()),
        )

    def _follow(
        self,
        world: LocalMap,
        centres: Centres,
        view: View,
        predicted: Array,
        previous: TrackedFrame | None,
        enough: int,
    ) -> tuple[PoseEstimate | None, Ids]:
        """Points of the previous frame (else the whole local map), in growing windows."""
        table = world.points
        if previous is not None:
            keypoints = np.flatnonzero(previous.points >= 0)
            keypoints = keypoints.compress(table.known(previous.points.take(keypoints)))
            ids = previous.points.take(keypoints)
            descriptors = previous.features.descriptors.take(keypoints, axis=0)
            octaves = previous.features.octaves.take(keypoints)
        else:
            ids = self._local_ids.compress(table.known(self._local_ids))
            descriptors = table.descriptor.take(table.rows(ids), axis=0)
            octaves = table.octave.take(table.rows(ids))
        positions = table.position.take(table.rows(ids), axis=0)
        pixels, inside = project(view.camera, predicted, positions)
        pixels, ids = pixels.compress(inside, axis=0), ids.compress(inside)
        octaves, descriptors = octaves.compress(inside), descriptors.compress(inside, axis=0)
        best: tuple[PoseEstimate, Ids] | None = None
        for radius in SEARCH_RADII:
            points = np.full(len(view.features), -1, np.int64)
            query, keypoint = match_projected(
                view.features,
                pixels,
                radius + 2.0 * self._factors[octaves],
                octaves,
                descriptors,
                MOTION_DISTANCE,
                MOTION_RATIO,
            )
            if len(query) >= enough:
                points[keypoint] = ids[query]
                solved = self._solve(
                    world, centres, view, predicted, points, FIRST_POSE_ROUNDS, FIRST_POSE_POINTS
                )
                if solved is not None:
                    estimate, used = solved
                    points[used.compress(~estimate.inliers)] = -1
                    count = int(estimate.inliers.sum())
                    if best is None or count > best[0].inliers.sum():
                        best = (estimate, points)
                    # A window that most matches agree in is wide enough.
                    if count >= 2 * enough and count >= 0.5 * len(used):
                        break
        if best is None or best[0].inliers.sum() < enough // 2:
            return None, np.full(len(view.features), -1, np.int64)
        return best

    def _extend(
        self,
        world: LocalMap,
        view: View,
        pose: Array,
        rows: Index,
        points: Ids,
    ) -> None:
        """Look for further points of the local map at their predicted places; fills ``points``."""
        table = world.points
        rows, pixels, octave = self._in_sight(world, view.camera, pose, rows)
        if self.learns:
            table.visible[rows] += 1
            table.visible[table.rows(points.compress(points >= 0))] += 1
        # A seed's place is doubtful along its ray, so its window is wider.
        radius = LOCAL_RADIUS * self._factors[octave] + np.where(
            table.log_depth_sigma.take(rows) > SEED_SIGMA, SEED_RADIUS, 0.0
        )
        query, keypoint = match_projected(
            view.features,
            pixels,
            radius,
            octave,
            table.descriptor.take(rows, axis=0),
            LOCAL_DISTANCE,
            LOCAL_RATIO,
            free=points < 0,
        )
        points[keypoint] = table.ids[rows[query]]

    def _in_sight(
        self, world: LocalMap, camera: Camera, pose: Array, rows: Index
    ) -> tuple[Index, Array, Index]:
        """Which points (rows) ought to be seen from a pose, at which pixels (n, 2) and levels (n,)."""
        table = world.points
        positions = table.position.take(rows, axis=0)
        pixels, inside = project(camera, pose, positions)
        rows, pixels = rows.compress(inside), pixels.compress(inside, axis=0)
        offset = pose[:3, 3] - positions.compress(inside, axis=0)
        distance = np.maximum(np.sqrt(np.einsum("ij,ij->i", offset, offset)), 1e-9)
        expected = expected_octaves(table, rows, distance, self._factors)
        inside = (expected >= -1) & (expected <= len(self._factors))
        along = np.einsum("ij,ij->i", offset, table.direction.take(rows, axis=0))
        inside &= along > MIN_VIEW_COSINE * distance
        rows, pixels = rows.compress(inside), pixels.compress(inside, axis=0)
        octave = np.minimum(np.maximum(expected.compress(inside), 0), len(self._factors) - 1).astype(np.intp)
        return rows, pixels, octave

    def _solve(
        self,
        world: LocalMap,
        centres: Centres,
        view: View,
        start: Array,
        points: Ids,
        rounds: tuple[int, int] = POSE_ROUNDS,
        most: int | None = None,
    ) -> tuple[PoseEstimate, Index] | None:
        """Refine a pose on (at ``most`` so many of) the points of a frame; and the keypoints used."""
        keypoints = np.flatnonzero(points >= 0)[:most]
        if len(keypoints) < 6:
            return None
        rows = world.points.rows(points.take(keypoints))
        estimate = self.pose.estimate(world, view, start, rows, keypoints, rounds, centres, self.expected)
        return estimate, keypoints
