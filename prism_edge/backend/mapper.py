"""The backend composed: keyframe in, window solved, map update out."""

from __future__ import annotations

import math
import time
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from prism_edge.backend.frame import keep_frame, take_references
from prism_edge.backend.global_map import GlobalKeyframe, GlobalMap
from prism_edge.backend.loop_closing import Accepted, LoopCloser, MapChanges
from prism_edge.backend.map_file import Arrays, Info
from prism_edge.backend.map_mount import mount_info, mount_of
from prism_edge.backend.map_scale import KnownScale
from prism_edge.backend.stored_map import from_arrays, to_arrays
from prism_edge.backend.unit import keep_unit
from prism_edge.backend.window import Solution, choose_window, solve
from prism_edge.config import BackendConfig
from prism_edge.errors import MapError
from prism_edge.geometry.cameras import PINHOLE, Camera
from prism_edge.geometry.poses import Array, inverse, normalised, transform
from prism_edge.messages import LARGEST_ID, Depth, Gate, Keyframe, MapUpdate, same_network
from prism_edge.tracking.depth_alignment import MIN_ALIGNED, agreement
from prism_edge.tracking.place_index import PlaceIndex
from prism_edge.tracking.point_table import TRIANGULATED_DEG
from prism_edge.tracking.seeding import sample_depth

LEAST_DEPTH_SIGMA = 0.02  # relative, of one pixel: an edge, a rounded place


class Mapper:
    """Owns the global map of one epoch. Knows nothing of the bus."""

    def __init__(
        self,
        config: BackendConfig,
        use_depth: bool = True,
        first_id: int = 0,
        seed: int = 0,
        use_rays: bool = True,
    ) -> None:
        """Updates are numbered from ``first_id``; ``seed`` is of the loops' RANSAC."""
        self._use_rays = use_rays
        self._config = config
        self._use_depth = use_depth
        self._seed = seed
        self.begin(0)
        self.sequence = first_id
        self.window = 0  # keyframes that the last solution had
        self._network = ""  # whose metres keyframes have

    def begin(self, epoch: int, world: GlobalMap | None = None, index: PlaceIndex | None = None) -> None:
        """Begin a map, empty or one that there was."""
        self.epoch = epoch
        self.mount = np.eye(4)  # base_from_camera of who began it, metres: until its first keyframe says
        self.world = GlobalMap(self._config.max_carried) if world is None else world
        self.loops = LoopCloser(self.world, self._config, self._use_depth, self._seed)
        if index is not None:
            self.loops.index = index

    def stored(self, in_use: bool = False) -> tuple[Info, Arrays]:
        """The map for a file (stored_map.py), with its epoch."""
        info, arrays = to_arrays(self.world, self.loops.index, in_use)
        return {**info, **mount_info(self.mount), "epoch": self.epoch}, arrays

    def restore(
        self, info: Info, arrays: Arrays, epoch: int | None = None, mount: Array | None = None
    ) -> KnownScale:
        """Take up a map that was stored, as ``epoch`` or its own; returns what was known of its unit.

        ``mount`` (4, 4) is for one that doesn't say what it was made with. Raises MapError for one that
        can't be.
        """
        world, index = from_arrays(info, arrays, self._config.max_carried)
        own, known, made_with = info.get("epoch"), KnownScale.of(info), mount_of(info)
        if type(own) is not int or not 0 <= own < LARGEST_ID:
            raise MapError("the map's epoch is none")
        self.begin(own if epoch is None else epoch, world, index)
        self._network = known.network
        known_mount = mount if made_with is None else made_with
        self.mount = self.mount if known_mount is None else known_mount
        return known

    def absorb(self, message: Keyframe) -> None:
        """Take in a keyframe; a new epoch begins a new map."""
        if message.epoch != self.epoch:
            self.begin(message.epoch)
        if not self.world.keyframes:
            self.mount = message.base_from_camera.copy()
        if len(message.kept):  # a message that was lost may have told of others that went
            there = np.array([k for k in self.world.keyframes if k < message.id], np.int64)
            gone = np.union1d(message.culled_keyframes, np.setdiff1d(there, message.kept))
            message = replace(message, culled_keyframes=gone)
        self.world.absorb(message)
        for gone in message.culled_keyframes.tolist():
            self.loops.index.remove(gone)

    def add_depth(self, message: Keyframe, depth: Depth, log_scale: float) -> None:
        """Attach a network's depth to a keyframe's keypoints, in map units.

        A network's scale wavers from frame to frame, much more than its relative depth is wrong. So each
        keyframe has a log scale of its own: that of its triangulated points, where there are enough. Depths
        that don't tell near from far are left out. A source that says how little its images' scales waver
        (``frame_sigma``) is taken in the map's own scale instead, and so keeps that from drifting.
        """
        keyframe = self.world.keyframes.get(message.id)
        if keyframe is not None:
            self._hear(depth.model)
            _attach_depth(keyframe, message.depths, message.parallax_deg, depth, log_scale)

    def add_late_depth(self, depth: Depth, log_scale: float) -> None:
        """As :meth:`add_depth`, of a keyframe solved since: held against the map as it is now."""
        keyframe = self.world.keyframes.get(depth.keyframe)
        if keyframe is not None:
            self._hear(depth.model)
            points = {keypoint: self.world.points[p] for p, keypoint in keyframe.observed.items()}
            rows = list(points)
            places = np.array([points[i].position for i in rows]).reshape(-1, 3)
            known, parallax_deg = np.zeros(len(keyframe.pixels)), np.zeros(len(keyframe.pixels))
            known[rows] = transform(inverse(keyframe.world_from_camera), places)[:, 2]
            parallax_deg[rows] = [points[i].parallax_deg for i in rows]
            _attach_depth(keyframe, known, parallax_deg, depth, log_scale)

    def _hear(self, network: str) -> None:
        """Another network's metres are not those of the one before: of two, the later's count."""
        if self._network and network and not same_network(network, self._network):
            for keyframe in self.world.keyframes.values():
                keyframe.depth_units, keyframe.unfitting = 0.0, None
        self._network = network or self._network

    def add_gate(self, message: Gate) -> None:
        """Attach the gate's weights to a keyframe's keypoints (those of a message that fits it).

        Relative to their median, at most 1: where a network is unsure of the whole view, that says nothing
        against any one of its points.
        """
        keyframe = self.world.keyframes.get(message.keyframe) if message.epoch == self.epoch else None
        if keyframe is not None and len(message.weights) == len(message.uncertainty) == len(keyframe.pixels):
            weights = np.clip(message.weights.astype(np.float64), 0.0, 1.0)
            known = weights[~np.isnan(message.uncertainty)]
            if len(known) > 0:
                weights = np.minimum(weights / max(float(np.median(known)), 1e-3), 1.0)
            keyframe.weights = np.where(np.isnan(message.uncertainty), np.nan, weights)

    def optimise(self, newest: int, log_scale: float) -> MapUpdate | None:
        """Solve the window of a keyframe and take its result over; None where nothing was solved."""
        started = time.perf_counter()
        window = choose_window(self.world, newest, self._config)
        units_per_metre = float(np.exp(-log_scale))
        solution = solve(
            self.world, window, self._config, units_per_metre, self._use_depth, self._use_rays
        )
        if solution is None:
            return None
        measured = any(self.world.keyframes[k].depth_sigma > 0 for k in window.free)
        if solution.unit_is_free and not measured:
            keep_unit(self.world, window.held[0], solution.poses, solution.points)
        return self._take_over(newest, solution, started)

    def _take_along(self, solution: Solution) -> None:
        """Points that the window left out (it takes a keyframe's best only) go with who made them."""
        keyframes = self.world.keyframes
        motions = {k: pose @ inverse(keyframes[k].world_from_camera) for k, pose in solution.poses.items()}
        made = {p for p, point in self.world.points.items() if point.made_by in motions}
        for p in made.union(*(keyframes[k].observed for k in motions)) - solution.points.keys():
            motion = motions.get(self.world.carrier(p))
            if motion is not None:
                point = self.world.points[p]
                point.position = motion[:3, :3] @ point.position + motion[:3, 3]

    def _move(self, solution: Solution) -> None:
        self._take_along(solution)
        for k, pose in solution.poses.items():
            self.world.keyframes[k].world_from_camera = pose
        for p, position in solution.points.items():
            self.world.points[p].position = position
            self.world.points[p].parallax_deg = solution.parallax_deg[p]
        for k, p in solution.outliers:
            self.world.drop_observation(k, p)

    def replay(self, told: Solution) -> None:
        """Take over what a life before this one had solved and told; what is not here is passed over."""
        world = self.world
        poses = {k: normalised(pose) for k, pose in told.poses.items() if k in world.keyframes}
        points = {p: place for p, place in told.points.items() if p in world.points}
        self._move(replace(told, poses=poses, points=points))
        take_references(world)

    def _take_over(self, newest: int, solution: Solution, started: float) -> MapUpdate:
        self._move(solution)
        self.window = len(solution.poses)
        # Where all of the map is moved to keep its frame, all keyframes are told, and take points along.
        everything = keep_frame(self.world)
        moved = list(self.world.keyframes if everything else solution.poses)
        self.sequence += 1
        alive = [p for p in solution.points if p in self.world.points]
        outliers = np.array(solution.outliers, np.int64).reshape(-1, 2)
        return MapUpdate(
            epoch=self.epoch,
            sequence=self.sequence,
            based_on=newest,
            solve_ms=(time.perf_counter() - started) * 1e3,
            keyframes=np.array(moved, np.int64),
            poses=np.array([self.world.keyframes[k].world_from_camera for k in moved]).reshape(-1, 4, 4),
            points=np.array(alive, np.int64),
            positions=np.array([self.world.points[p].position for p in alive]).reshape(-1, 3),
            parallax_deg=np.array([solution.parallax_deg[p] for p in alive], np.float32),
            weights=np.array([self.world.gate_weight(p) for p in alive], np.float32),
            dropped_keyframes=outliers[:, 0],
            dropped_points=outliers[:, 1],
            camera=_pinhole(self.world.camera),
            readout_ms=self.world.readout_ms,
            everything=everything,
        )

    def whole(
        self,
        newest: int,
        changes: MapChanges,
        beside: MapUpdate | None = None,
        closed: Accepted | None = None,
    ) -> MapUpdate:
        """An update of everything, after a loop or a global adjustment; ``beside`` is the window's own."""
        world = self.world
        self.sequence += 1
        dropped = np.array(changes.dropped, np.int64).reshape(-1, 2)
        if beside is not None:
            own = np.stack([beside.dropped_keyframes, beside.dropped_points], axis=1)
            dropped = np.concatenate([own, dropped])
        fused = np.array(changes.fused, np.int64).reshape(-1, 2)
        added = np.array(changes.added, np.int64).reshape(-1, 3)
        points = list(world.points.items())
        return MapUpdate(
            epoch=self.epoch,
            sequence=self.sequence,
            based_on=newest,
            loop_query=-1 if closed is None else closed.query,
            loop_candidate=-1 if closed is None else closed.candidate,
            loop_units=np.array(() if closed is None or closed.units is None else closed.units),
            solve_ms=0.0 if beside is None else beside.solve_ms,
            keyframes=np.array(list(world.keyframes), np.int64),
            poses=np.array([k.world_from_camera for k in world.keyframes.values()]).reshape(-1, 4, 4),
            points=np.array([p for p, _ in points], np.int64),
            positions=np.array([point.position for _, point in points]).reshape(-1, 3),
            parallax_deg=np.array([point.parallax_deg for _, point in points], np.float32),
            dropped_keyframes=dropped[:, 0],
            dropped_points=dropped[:, 1],
            fused_from=fused[:, 0],
            fused_into=fused[:, 1],
            added_keyframes=added[:, 0],
            added_points=added[:, 1],
            added_keypoints=added[:, 2],
            camera=_pinhole(world.camera),
            readout_ms=world.readout_ms,
            everything=True,
        )

    def nothing(self, message: Keyframe) -> MapUpdate:
        """An update that changes nothing: lockstep's answer where there was nothing to solve."""
        self.sequence += 1
        ids, none = np.zeros(0, np.int64), np.zeros((0, 3))
        return MapUpdate(
            epoch=message.epoch,
            sequence=self.sequence,
            based_on=message.id,
            solve_ms=0.0,
            keyframes=ids,
            poses=np.zeros((0, 4, 4)),
            points=ids,
            positions=none,
            parallax_deg=np.zeros(0, np.float32),
            dropped_keyframes=ids,
            dropped_points=ids,
        )


def _attach_depth(
    keyframe: GlobalKeyframe,
    known: NDArray[np.floating[Any]],
    parallax_deg: NDArray[np.floating[Any]],
    depth: Depth,
    log_scale: float,
) -> None:
    """``known`` (n,) along z and ``parallax_deg`` (n,) are of keypoints' points, map units; 0 for none."""
    raw = keyframe.camera.distort_pixels(keyframe.pixels)
    good, network = sample_depth(depth.depth, depth.image_to_depth, raw)
    own = np.where(good, network, 0.0)
    firm = good & (parallax_deg >= TRIANGULATED_DEG) & (known > 0)
    factor = float(np.exp(-log_scale))
    if math.isfinite(depth.frame_sigma) and depth.frame_sigma >= 0.0:
        keyframe.depth_sigma = max(depth.frame_sigma, LEAST_DEPTH_SIGMA)
    elif firm.sum() >= MIN_ALIGNED:
        agreed = agreement(known[firm].astype(np.float64), own[firm])
        if not agreed.informative:
            keyframe.unfitting = own  # that may be the map's fault (second_start.py)
            return
        factor = agreed.units_per_metre
    keyframe.depths = own * factor
    keyframe.depth_units = 0.0 if keyframe.depth_sigma > 0 else factor


def _pinhole(camera: Camera | None) -> Array:
    """A pinhole camera as messages carry it; other models have no lens of their own to be found."""
    return camera.to_array() if camera is not None and camera.model == PINHOLE else np.zeros(0)
