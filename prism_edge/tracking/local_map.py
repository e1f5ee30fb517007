"""The tracker's map: keyframes, points, and who sees what."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from prism_edge.geometry.cameras import Camera
from prism_edge.geometry.poses import Array
from prism_edge.tracking.features import Features
from prism_edge.tracking.point_table import Ids, Index, PointTable

NO_POINT = -1
LEAST_SHARED = 15  # points, for keyframes to be covisible


@dataclass
class LocalKeyframe:
    """One keyframe of the local map; ``points`` holds the id of each keypoint's map point or -1."""

    id: int
    index: int
    stamp_ns: int
    world_from_camera: Array
    camera: Camera
    features: Features
    points: Ids
    neighbours: list[int] = field(default_factory=list)  # covisible when it or they were made, best first
    metres: Array | None = None  # (n,) depth of each keypoint as the network has it; 0: none
    stands_in: bool = False  # for an older one that shows the same from as good as the same place
    twist: Array = field(default_factory=lambda: np.zeros(6))  # its camera's, a second; 0: nothing is known

    def observed(self) -> Index:
        """Keypoints that have a point."""
        return np.flatnonzero(self.points != NO_POINT)

    def free(self) -> Index:
        """Keypoints without one."""
        return np.flatnonzero(self.points == NO_POINT)


@dataclass
class Changes:
    """What happened to the map since the last keyframe message: the backend hears of it with the next."""

    new_points: list[Ids] = field(default_factory=list)
    late: list[tuple[int, int, int]] = field(default_factory=list)  # point, keyframe, keypoint
    culled_points: list[Ids] = field(default_factory=list)
    culled_keyframes: list[int] = field(default_factory=list)
    fused: list[tuple[int, int]] = field(default_factory=list)  # from, into


class LocalMap:
    """Keyframes and points in one world frame and unit."""

    def __init__(self, readout_ms: float = 0.0) -> None:
        """``readout_ms``: of a rolling shutter that nobody has said, as the backend has found it."""
        self.points = PointTable()
        self.keyframes: dict[int, LocalKeyframe] = {}
        self.changes = Changes()
        self.heard = -1  # the newest keyframe that a correction knew
        self.readout_ms = readout_ms
        self.announced = -1  # the newest whose message has gone out: what it gains later must be told apart

    def newest(self) -> LocalKeyframe:
        """The latest keyframe; the map must have one."""
        return self.keyframes[max(self.keyframes)]

    def centres(self) -> tuple[Ids, Array]:
        """All keyframes' ids (n,), ascending, and where their cameras stand (n, 3)."""
        numbers = sorted(self.keyframes)
        # One call for all: an array made of many small ones takes several times as long.
        poses = np.concatenate([self.keyframes[number].world_from_camera for number in numbers])
        return np.array(numbers, np.int64), poses.reshape(-1, 4, 4)[:, :3, 3]

    def add_keyframe(self, keyframe: LocalKeyframe) -> None:
        """Insert a keyframe whose ``points`` are ids of the table; refreshes what its points look like."""
        self.keyframes[keyframe.id] = keyframe
        keypoints = keyframe.observed()
        if len(keypoints) == 0:
            return
        rows = self.points.rows(keyframe.points[keypoints])
        self.points.observations[rows] += 1
        self._refresh_appearance(keyframe, keypoints, rows)

    def _refresh_appearance(self, keyframe: LocalKeyframe, keypoints: Index, rows: Index) -> None:
        features, centre = keyframe.features, keyframe.world_from_camera[:3, 3]
        self._note_view(rows, centre, features.octaves[keypoints], features.descriptors[keypoints])

    def _note_view(
        self, rows: Index, centres: Array, octaves: NDArray[np.intp], descriptors: NDArray[np.uint64]
    ) -> None:
        """How points are seen from ``centres`` (3,) or (n, 3); of several views of one the last counts."""
        table = self.points
        offset = centres - table.position[rows]
        distance = np.maximum(np.linalg.norm(offset, axis=1), 1e-9)
        table.direction[rows] = offset / distance[:, None]
        table.distance[rows] = distance
        table.octave[rows] = octaves
        table.descriptor[rows] = descriptors

    def look_anew(self) -> None:
        """Note again from where, and how far, each point was seen last: a loop has moved what sees it."""
        views = [self.keyframes[number] for number in sorted(self.keyframes)]
        seen = [view.observed() for view in views]
        if not sum(map(len, seen)):
            return
        rows = self.points.rows(np.concatenate([v.points[o] for v, o in zip(views, seen, strict=True)]))
        centres = np.array([view.world_from_camera[:3, 3] for view in views])
        octaves = np.concatenate([v.features.octaves[o] for v, o in zip(views, seen, strict=True)])
        words = np.concatenate([v.features.descriptors[o] for v, o in zip(views, seen, strict=True)])
        self._note_view(rows, np.repeat(centres, list(map(len, seen)), axis=0), octaves, words)

    def add_points(
        self,
        keyframe: LocalKeyframe,
        keypoints: Index,
        positions: Array,
        log_depth_sigma: Array,
        parallax_deg: Array | float,
    ) -> Ids:
        """New points first seen at ``keypoints`` of a keyframe that is in the map."""
        ids = self.points.add(
            len(keypoints),
            position=positions,
            log_depth_sigma=log_depth_sigma,
            parallax_deg=parallax_deg,
            reference=keyframe.id,
            reference_keypoint=keypoints,
            born_ns=keyframe.stamp_ns,
            observations=1,
        )
        keyframe.points[keypoints] = ids
        self._refresh_appearance(keyframe, keypoints, self.points.rows(ids))
        self.changes.new_points.append(ids)
        if keyframe.id <= self.announced:
            pairs = zip(ids.tolist(), keypoints.tolist(), strict=True)
            self.changes.late += [(point, keyframe.id, keypoint) for point, keypoint in pairs]
        return ids

    def add_observation(self, point: int, row: int, keyframe: LocalKeyframe, keypoint: int) -> None:
        """An earlier keyframe turns out to see a point too."""
        keyframe.points[keypoint] = point
        self.points.observations[row] += 1
        self.changes.late.append((point, keyframe.id, keypoint))

    def cull_points(self, rows: Index) -> None:
        """Remove points from the map and from every keyframe."""
        if len(rows) == 0:
            return
        ids = self.points.ids[rows]
        self.points.alive[rows] = False
        self.changes.culled_points.append(ids.copy())
        for keyframe in self.may_see(ids):
            observed = keyframe.observed()
            gone = ~self.points.alive.take(self.points.rows(keyframe.points.take(observed)))
            keyframe.points[observed.compress(gone)] = NO_POINT

    def weigh(self, point_ids: Ids, weights: NDArray[np.float32]) -> None:
        """What the backend's gate thinks of points; no weights: as before."""
        if len(weights) == len(point_ids):
            known = self.points.known(point_ids)
            self.points.weight[self.points.rows(point_ids[known])] = np.clip(weights[known], 0.0, 1.0)

    def drop_observations(self, keyframe_ids: Ids, point_ids: Ids) -> None:
        """The backend found these observations wrong; points left with fewer than two are culled."""
        for keyframe_id in np.unique(keyframe_ids):
            keyframe = self.keyframes.get(int(keyframe_id))
            if keyframe is None:
                continue
            wrong = np.isin(keyframe.points, point_ids[keyframe_ids == keyframe_id])
            known = keyframe.points[wrong]
            self.points.observations[self.points.rows(known[self.points.known(known)])] -= 1
            keyframe.points[wrong] = NO_POINT
        affected = np.unique(point_ids)
        rows = self.points.rows(affected[self.points.known(affected)])
        self.cull_points(rows[self.points.observations[rows] < 2])

    def may_see(self, point_ids: Ids) -> Iterator[LocalKeyframe]:
        """Keyframes but for those whose points are all older than these: most of a large map's.

        To look at a keyframe's newest point costs a fifth of what it costs to look for some among its points.
        """
        if len(point_ids):
            oldest = point_ids.min()
            for keyframe in self.keyframes.values():
                if np.maximum.reduce(keyframe.points, initial=NO_POINT) >= oldest:
                    yield keyframe

    def votes(self, point_ids: Ids) -> dict[int, int]:
        """How many of the points each keyframe sees (only keyframes that see any)."""
        marked = np.zeros(len(self.points) + 1, bool)
        marked[self.points.rows(point_ids)] = True
        counts: dict[int, int] = {}
        for keyframe in self.may_see(point_ids):
            seen = keyframe.points.compress(keyframe.points >= 0)
            count = int(np.count_nonzero(marked.take(self.points.rows(seen))))
            if count:
                counts[keyframe.id] = count
        return counts

    def nearest(self, points: Ids) -> LocalKeyframe | None:
        """The keyframe that sees most of a view's ``points``, the newest of several; None where none does."""
        seen = points.compress(points != NO_POINT)
        votes = self.votes(seen.compress(self.points.known(seen)))
        return self.keyframes[max(votes, key=lambda k: (votes[k], k))] if votes else None

    def covisible(self, keyframe: LocalKeyframe, most: int) -> list[LocalKeyframe]:
        """Keyframes that share the most points with one, best first."""
        votes = self.votes(keyframe.points[keyframe.observed()])
        votes.pop(keyframe.id, None)
        ranked = sorted(votes.items(), key=lambda item: (-item[1], -item[0]))
        return [self.keyframes[k] for k, shared in ranked[:most] if shared >= LEAST_SHARED]

    def rows_seen_by(self, keyframes: list[LocalKeyframe], most: int) -> Index:
        """Rows of the live points that some keyframes see; earlier keyframes in the list count first."""
        seen: list[Ids] = []
        total = 0
        marked = np.zeros(len(self.points) + 1, bool)
        for keyframe in keyframes:
            ids = keyframe.points.compress(keyframe.points >= 0)
            rows = self.points.rows(ids)
            rows = rows.compress(~marked.take(rows))
            marked[rows] = True
            seen.append(rows)
            total += len(rows)
            if total >= most:
                break
        if not seen:
            return np.zeros(0, np.intp)
        rows = np.concatenate(seen)[:most]
        return rows.compress(self.points.alive.take(rows))

    def depths_in(self, keyframe: LocalKeyframe) -> tuple[Index, Array]:
        """Observed keypoints of a keyframe and the depth of their points along its z axis."""
        keypoints = keyframe.observed()
        rows = self.points.rows(keyframe.points.take(keypoints))
        pose = keyframe.world_from_camera
        return keypoints, (self.points.position.take(rows, axis=0) - pose[:3, 3]) @ pose[:3, 2]

    def median_depth(self, keyframe: LocalKeyframe) -> float:
        """Median depth of what a keyframe sees; 1 where it sees nothing."""
        _, depths = self.depths_in(keyframe)
        depths = depths.compress(depths > 0)
        return float(np.median(depths)) if len(depths) else 1.0

