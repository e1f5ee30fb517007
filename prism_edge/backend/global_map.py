"""The backend's map: everything the keyframe messages have said, with corrected poses and points."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from prism_edge.backend.carried import Carried
from prism_edge.backend.rows_at_once import message_at_once
from prism_edge.geometry.cameras import Camera
from prism_edge.geometry.poses import Array, inverse, normalised, transform
from prism_edge.messages import Keyframe
from prism_edge.tracking.features import Features
from prism_edge.tracking.found_lens import in_found_lens
from prism_edge.tracking.local_map import LEAST_SHARED
from prism_edge.tracking.pose_refinement import refine_pose
from prism_edge.tracking.rolling_shutter import found_readout

MIN_COMMON = 15
LONG_AGO = -(1 << 62)  # a stamp before all others, of what comes from a file
UNKNOWN = -1
MAX_RENAMED = 20_000  # points that became others, remembered for a while


def no_features() -> Features:
    """The keypoints of a view that shows nothing."""
    return Features.build(np.zeros((0, 2)), np.zeros(0, np.intp), np.zeros((0, 4), np.uint64), 1, 1)


@dataclass
class GlobalKeyframe:
    """A keyframe with its observations: point id -> keypoint."""

    id: int
    index: int
    camera: Camera
    world_from_camera: Array
    pixels: NDArray[np.float64]  # (n, 2), ideal
    sigmas: NDArray[np.float64]  # of each keypoint, relative to one of the finest pyramid level
    observed: dict[int, int]
    # Network depth at each keypoint along z, in map units by this keyframe's own scale; 0 for none.
    depths: NDArray[np.float64] | None = None
    # Their relative noise where the source knows it, and they are in the map's scale; else 0.
    depth_sigma: float = 0.0
    depth_units: float = 0.0  # map units that a metre of a network's depth became there; 0: not known
    unfitting: NDArray[np.float64] | None = None  # a network's metres that don't fit the map; 0 for none
    features: Features = field(default_factory=no_features, repr=False)
    scale_factor: float = 1.2  # between pyramid levels
    travelled: float = 0.0  # path length to here, map units as the tracker had them
    weights: NDArray[np.float64] | None = None  # the gate's of keypoints, in [0, 1]; nan: nothing is known
    stands_in: bool = False  # for an older one that shows the same from as good as the same place
    stamp_ns: int = LONG_AGO  # of its image, where this run took it
    part: int | None = None  # of the map, as the tracker has it; None: nobody has said (earlier builds' maps)
    taken_ns: int | None = None  # the same, whichever run took it; None where a file did not say
    grown: float = 1.0  # by how much a loop has lengthened its part since it was made
    # How its camera moved, a second, in its own frame and the units it was made in; 0: nothing is known.
    twist: Array = field(default_factory=lambda: np.zeros(6))
    # world_from_camera, were the map's frame kept to the last digit (frame.py).
    reference: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        self.reference = self.world_from_camera

    @property
    def present_twist(self) -> Array:
        """:attr:`twist` in the unit that the keyframe's part has now."""
        return self.twist * np.repeat((self.grown, 1.0), 3)

    def gate_weight(self, keypoint: int) -> float:
        """The gate's weight of a keypoint; 1 where nothing is held against it."""
        weight = 1.0 if self.weights is None else float(self.weights[keypoint])
        return weight if math.isfinite(weight) else 1.0


@dataclass
class GlobalPoint:
    """A point and the keyframes that see it."""

    position: Array
    keyframes: set[int] = field(default_factory=set)
    parallax_deg: float = 0.0  # widest angle between its rays when last solved
    made_by: int = UNKNOWN  # keyframe that it was made from; a saved map doesn't say


class GlobalMap:
    """Keyframes and points of one epoch.

    What the tracker culled is remembered by its pose alone, and of that only the ``max_carried`` culled last:
    frames that an older one carried can no longer be placed.
    """

    def __init__(self, max_carried: int = 10_000) -> None:
        self.keyframes: dict[int, GlobalKeyframe] = {}
        self.points: dict[int, GlobalPoint] = {}
        self.carried = Carried(max_carried)  # a culled keyframe still carries frames
        # Points that a loop made one: the tracker may still speak of the old identity until it hears of it.
        self._now: dict[int, int] = {}
        self.growth: dict[int, float] = {}  # of parts in another unit by a loop, till the tracker has it too
        # Of a rolling shutter: as found here where nobody says it; whether a keyframe's camera does.
        self.readout_ms, self.readout_said = 0.0, False

    def absorb(self, message: Keyframe) -> GlobalKeyframe:
        """Take in a keyframe message.

        While corrections are on their way to the tracker, its world and this one differ: the keyframe is put
        where it fits the points that both know, points made from it with it, and those made from earlier
        ones where they are beside its anchor. Points that a loop made one here are taken for what they
        became. Its pixels are brought to the lens and the readout found here.
        """
        if not (self.keyframes or message.readout_said):  # a map before this one has shown it
            self.readout_ms = message.readout_ms
        message = in_found_lens(self._renamed(message), self.keyframes)
        camera = Camera.from_array(message.camera_model, message.camera)
        message = self._in_present_unit(message_at_once(message, found_readout(self, camera)))
        self.readout_said |= message.readout_said
        of_earlier, world_correction = self._corrections(message)
        told = message.new_points.tolist(), message.new_positions, message.new_by.tolist()
        for point, position, made_by in zip(*told, strict=True):
            correction = world_correction if made_by == message.id else of_earlier
            moved = correction[:3, :3] @ position + correction[:3, 3]
            known = self.points.setdefault(point, GlobalPoint(moved))
            known.position, known.made_by = moved, made_by
        for old, kept in zip(message.fused_from.tolist(), message.fused_into.tolist(), strict=True):
            self.fuse(old, kept)
        for point in message.culled_points.tolist():
            self._forget_point(point)
        self._observe_late(message)
        keypoints = np.flatnonzero(message.points >= 0)
        added = GlobalKeyframe(
            message.id,
            message.index,
            camera,
            normalised(world_correction @ message.world_from_camera),
            message.pixels.astype(np.float64),
            message.scale_factor ** message.octaves.astype(np.float64),
            {},
            features=_features(message, camera),
            scale_factor=message.scale_factor,
            travelled=message.travelled,
            stands_in=message.stands_in,
            stamp_ns=message.stamp_ns,
            part=message.part,
            taken_ns=message.stamp_ns,
            grown=self.growth.get(message.part, 1.0),
            twist=message.twist,
        )
        for newer, older in message.joined.tolist():
            self.growth.pop(newer, None)
            for keyframe in self.keyframes.values():
                keyframe.part = older if keyframe.part == newer else keyframe.part
        self.keyframes[message.id] = added
        for keypoint in keypoints.tolist():
            self.observe(message.id, int(message.points[keypoint]), keypoint)
        # Last, as in the tracker: what the new keyframe sees keeps points that these leave behind.
        for keyframe in message.culled_keyframes.tolist():
            self._forget_keyframe(keyframe)
        return added

    @property
    def camera(self) -> Camera | None:
        """The newest keyframe's, as far as its lens is known."""
        return self.keyframes[max(self.keyframes)].camera if self.keyframes else None

    def take_lens(self, lens: Camera) -> None:
        """From now on the camera has this lens, and always had."""
        for keyframe in self.keyframes.values():
            if keyframe.camera != lens and keyframe.camera.like(lens):
                keyframe.pixels = lens.pixels_of(keyframe.camera, keyframe.pixels)
                keyframe.features = keyframe.features.through(lens, keyframe.camera)
                keyframe.camera = lens

    def move(self, motion: Array, part: set[int]) -> None:
        """Carry keyframes, and points that they see, along by a rigid motion (4, 4), new world from old."""
        for k in part:
            self.keyframes[k].world_from_camera = motion @ self.keyframes[k].world_from_camera
        points = [point for point in self.points.values() if not point.keyframes.isdisjoint(part)]
        if points:
            places = transform(motion, np.array([point.position for point in points]))
            for point, place in zip(points, places, strict=True):
                point.position = place

    def part_grew(self, part: int, factor: float) -> None:
        """A loop has made the lengths of a part so many times as long."""
        self.growth[part] = factor * self.growth.get(part, 1.0)

    def _in_present_unit(self, message: Keyframe) -> Keyframe:
        """The message as if the tracker had heard by then in what unit its part is now."""
        factor, centre = self.growth.get(message.part, 1.0), message.world_from_anchor[:3, 3]
        if factor == 1.0:
            return message
        camera = message.world_from_camera.copy()
        camera[:3, 3] = centre + factor * (camera[:3, 3] - centre)
        points = centre + factor * (message.new_positions - centre)
        return replace(message, world_from_camera=camera, new_positions=points)

    def _corrections(self, message: Keyframe) -> tuple[Array, Array]:
        """This map's world from the tracker's (4, 4), near the keyframe before and at a new one."""
        moved, anchored = np.eye(4), message.anchor in self.keyframes
        if anchored:
            moved = self.keyframes[message.anchor].world_from_camera @ inverse(message.world_from_anchor)
        new = set(message.new_points.tolist())
        pairs = [(i, p) for i, p in enumerate(message.points.tolist()) if p in self.points and p not in new]
        if len(pairs) >= MIN_COMMON:
            keypoints = np.array([i for i, _ in pairs])
            estimate = refine_pose(
                Camera.from_array(message.camera_model, message.camera),
                normalised(moved @ message.world_from_camera),
                np.array([self.points[p].position for _, p in pairs]),
                message.pixels[keypoints].astype(np.float64),
                message.scale_factor ** message.octaves[keypoints].astype(np.float64),
            )
            if estimate.inliers.sum() >= MIN_COMMON:
                fitted = estimate.world_from_camera @ inverse(message.world_from_camera)
                return (moved if anchored else fitted), fitted
        return moved, moved

    def _renamed(self, message: Keyframe) -> Keyframe:
        """The message in the identities that points have here."""
        if not self._now:
            return message
        for kept in message.fused_into.tolist():
            # Made one here the other way round than there: what the tracker keeps is what counts.
            if kept in self._now and (present := self.present(kept)) in message.fused_from:
                del self._now[kept]
                self.fuse(present, kept)
        points = _ids(map(self.present, message.points.tolist()))
        # Two keypoints may show what is one point now: as in fuse(), the one that showed it before keeps it.
        by_name = np.argsort(points != message.points, kind="stable")
        _, firsts = np.unique(points[by_name], return_index=True)
        double = np.ones(len(points), bool)
        double[by_name[firsts]] = False
        points[double] = -1
        fresh = np.array([p not in self._now for p in message.new_points.tolist()], bool)
        return replace(
            message,
            points=points,
            new_points=message.new_points[fresh],
            new_positions=message.new_positions[fresh],
            new_by=message.new_by[fresh],
            culled_points=_ids(p for p in message.culled_points.tolist() if p not in self._now),
            late_points=_ids(map(self.present, message.late_points.tolist())),
            fused_from=_ids(map(self.present, message.fused_from.tolist())),
            fused_into=_ids(map(self.present, message.fused_into.tolist())),
        )

    def carrier(self, point: int) -> int:
        """The keyframe that a point goes with while nothing else is said of its place; as in the tracker."""
        made_by = self.points[point].made_by
        return made_by if made_by in self.keyframes else min(self.points[point].keyframes, default=UNKNOWN)

    def present(self, point: int) -> int:
        """The identity that a point has now."""
        while point in self._now:
            point = self._now[point]
        return point

    def renamed(self) -> NDArray[np.int64]:
        """Points that there were, oldest first, and what they are now (n, 2)."""
        pairs = [(old, self.present(old)) for old in self._now if old not in self.points]
        return np.array(pairs, np.int64).reshape(-1, 2)

    def rename(self, renamed: NDArray[np.int64]) -> None:
        """What :meth:`renamed` has told, of a map that had the same points."""
        self._now = dict(renamed.tolist())

    def drop_observation(self, keyframe: int, point: int) -> None:
        """Forget that a keyframe sees a point; a point nobody sees is forgotten too."""
        if keyframe in self.keyframes:
            self.keyframes[keyframe].observed.pop(point, None)
        seen = self.points.get(point)
        if seen is not None:
            seen.keyframes.discard(keyframe)
            if len(seen.keyframes) < 2:
                self._forget_point(point)

    def gate_weight(self, point: int) -> float:
        """Mean of the gate's weights of a point's observations that it knows anything of; 1 without any."""
        total, count = 0.0, 0
        for k in self.points[point].keyframes:
            keyframe = self.keyframes[k]
            weight = math.nan if keyframe.weights is None else keyframe.weights[keyframe.observed[point]]
            if not math.isnan(weight):
                total, count = total + float(weight), count + 1
        return total / count if count else 1.0

    def covisible(self, keyframe: int) -> list[tuple[int, int]]:
        """(keyframe, shared points) of every keyframe that shares points with one, most first."""
        seen = (self.points[point].keyframes for point in self.keyframes[keyframe].observed)
        votes = Counter(chain.from_iterable(seen))  # counted in C: in a small room a hundred see each point
        votes.pop(keyframe, None)
        return sorted(votes.items(), key=lambda item: (-item[1], -item[0]))

    def neighbours(self, keyframe: int) -> list[int]:
        """Those covisible with one, most shared points first."""
        return [k for k, shared in self.covisible(keyframe) if shared >= LEAST_SHARED]

    def table(self) -> tuple[NDArray[np.int64], Array]:
        """Number (n,) and world_from_camera (n, 4, 4) of all keyframes, culled ones where they hang."""
        ids = _ids(self.keyframes)
        poses = np.array([k.world_from_camera for k in self.keyframes.values()]).reshape(-1, 4, 4)
        if not len(self.carried):
            return ids, poses
        order = np.argsort(ids)
        anchors = poses[order[np.searchsorted(ids, self.carried.numbers[:, 1], sorter=order)]]
        links = anchors @ self.carried.links
        return np.concatenate([ids, self.carried.ids]), np.concatenate([poses, links])

    def observe(self, keyframe: int, point: int, keypoint: int) -> None:
        """Note that a keyframe sees a point; nothing where either is not here."""
        if keyframe in self.keyframes and point in self.points:
            self.keyframes[keyframe].observed[point] = keypoint
            self.points[point].keyframes.add(keyframe)

    def _observe_late(self, message: Keyframe) -> None:
        """What earlier keyframes turn out to see; a keypoint shows one point, as the tracker says which.

        Another may have come to it here: by a loop that the tracker had not heard of, or from a life of its
        before this one.
        """
        shown: dict[int, dict[int, int]] = {}  # of each keyframe that this is about: the point at a keypoint
        late = message.late_points, message.late_keyframes, message.late_keypoints
        for point, number, keypoint in zip(*(column.tolist() for column in late), strict=True):
            keyframe = self.keyframes.get(number)
            if keyframe is None or point not in self.points:
                continue
            if number not in shown:
                shown[number] = {i: p for p, i in keyframe.observed.items()}
            other = shown[number].get(keypoint, point)
            if other != point and keyframe.observed.get(other) == keypoint:
                del keyframe.observed[other]
                self.points[other].keyframes.discard(number)
                if not self.points[other].keyframes:
                    self._forget_point(other)
            shown[number][keypoint] = point
            self.observe(number, point, keypoint)

    def _forget_point(self, point: int) -> None:
        gone = self.points.pop(point, None)
        if gone is not None:
            for keyframe in gone.keyframes:
                self.keyframes[keyframe].observed.pop(point, None)

    def _forget_keyframe(self, keyframe: int) -> None:
        gone = self.keyframes.get(keyframe)
        if gone is None or len(self.keyframes) < 2:
            return
        shared, others = self.covisible(keyframe), self.keyframes.keys() - {keyframe}
        kin = (k for k in others if gone.part is None or self.keyframes[k].part in (None, gone.part))
        anchor = shared[0][0] if shared else min(kin, key=lambda k: (abs(k - keyframe), k), default=None)
        if anchor is None:  # all of its part has gone, of which nobody knows where it lay
            self.carried.drop(keyframe)
        else:
            link = inverse(self.keyframes[anchor].world_from_camera) @ gone.world_from_camera
            # What hung on it hangs on its anchor now, so that no chain grows and any link can be forgotten.
            self.carried.rehang(keyframe, anchor, link)
            self.carried.add(keyframe, anchor, link, gone.index)
        for point in list(gone.observed):
            self.points[point].keyframes.discard(keyframe)
            if len(self.points[point].keyframes) < 2:
                self._forget_point(point)
        del self.keyframes[keyframe]

    def fuse(self, old: int, kept: int) -> None:
        """Make two points one; where a keyframe saw both, it keeps seeing ``kept`` as it did."""
        kept = self.present(kept)  # else names could go round: both sides may have made these one
        if old not in self.points or old == kept:
            return
        # A point that came and went between two messages may be a link to one that stayed.
        gone = self.points[old]
        self.points.setdefault(kept, GlobalPoint(gone.position, made_by=gone.made_by))
        for keyframe in sorted(self.points[old].keyframes):
            keypoint = self.keyframes[keyframe].observed.pop(old)
            if kept not in self.keyframes[keyframe].observed:
                self.observe(keyframe, kept, keypoint)
        del self.points[old]
        self._now[old] = kept
        while len(self._now) > MAX_RENAMED:
            del self._now[next(iter(self._now))]


def _ids(points: Iterable[int]) -> NDArray[np.int64]:
    return np.array(list(points), np.int64)


def _features(message: Keyframe, camera: Camera) -> Features:
    return Features.build(
        message.pixels.astype(np.float64),
        message.octaves.astype(np.intp),
        np.ascontiguousarray(message.descriptors).view(np.uint64).reshape(-1, 4),
        camera.width,
        camera.height,
    )
