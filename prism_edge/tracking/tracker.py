"""The tracker: frames in, poses and keyframes out; composed of the parts beside it."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import replace
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from prism_edge.config import TrackingConfig
from prism_edge.geometry.cameras import PINHOLE, Camera
from prism_edge.geometry.poses import Array, normalised, scaled
from prism_edge.messages import DEGRADED, F32, INITIALISING, LOST, MapUpdate, beyond
from prism_edge.tracking import mapping
from prism_edge.tracking.baseline import Baselines
from prism_edge.tracking.early_shape import is_contradicted
from prism_edge.tracking.features import OrbExtractor
from prism_edge.tracking.first_keyframe import FirstKeyframe
from prism_edge.tracking.first_map import SecondView
from prism_edge.tracking.found_lens import found_lens
from prism_edge.tracking.frame_result import FrameResult, beside, nothing
from prism_edge.tracking.frame_tracking import FrameTracker, TrackedFrame
from prism_edge.tracking.keyframe_culling import keeping_bound, take_out
from prism_edge.tracking.keyframe_decision import decide, is_overdue, shown_before
from prism_edge.tracking.local_map import LocalKeyframe, LocalMap
from prism_edge.tracking.map_correction import see_through, take_over
from prism_edge.tracking.motion import ConstantVelocity
from prism_edge.tracking.place_index import PlaceIndex
from prism_edge.tracking.point_table import Ids
from prism_edge.tracking.recovery import clearly_better, misled, recover
from prism_edge.tracking.reference import Reference
from prism_edge.tracking.relocalisation import Relocaliser
from prism_edge.tracking.rolling_shutter import RollingShutter, found_readout, see_at_once
from prism_edge.tracking.search import Search
from prism_edge.tracking.second_look import look_again
from prism_edge.tracking.seeding import seed_at_middle, seed_from_depth
from prism_edge.tracking.submaps import Parts
from prism_edge.tracking.unheard import adjust_unheard
from prism_edge.tracking.view import View

log = logging.getLogger("prism_edge.tracking")

MIN_FIRST_FEATURES = 80
REFRESH_FRAMES = 10  # the local map is chosen anew at least this often


class Tracker:
    """Owns the local map. Not thread-safe; knows nothing of where frames come from."""

    def __init__(self, config: TrackingConfig, seed: int = 0, first_id: int = 0) -> None:
        """Epochs and keyframes are numbered from ``first_id``."""
        self._config, self._seed = config, seed
        self._extractor = OrbExtractor(config)
        factors, self.scale_factor = self._extractor.scale_factors, config.scale_factor
        self.proven_after_s = config.proven_after_s
        self._frames = FrameTracker(factors, config.max_local_points, config.proven_after_s)
        self.world, self.places = LocalMap(), Relocaliser(seed)
        self.parts, self._baselines = Parts(), Baselines()
        self._search = Search()
        self._waiting: LocalKeyframe | None = None  # a new part's first keyframe, until its depth has come
        self.wants_probe = False  # lost, and the last frame shows something
        self.may_map = True  # False: the map stays as it is, wherever the camera goes
        self.epoch = self._next_keyframe = first_id
        self.log_scale = self.map_log_scale = 0.0  # as published; what the map is built by
        self.last: TrackedFrame | None = None
        self.motion, self.shutter = ConstantVelocity(), RollingShutter(config.readout_ms)
        self._seen_at: int | None = None  # stamp of the last tracked frame
        self._began_at: int | None = None  # of this map's first; None for one that was there before
        self._at, self.first, self._since_refresh = Reference(), FirstKeyframe(), 0
        self.initialised = False  # True once a frame was tracked in this map
        self._result: FrameResult | None = None
        self._fresh: tuple[int, TrackedFrame] | None = None  # tracked, not yet judged as a keyframe
        self._unmapped: tuple[LocalKeyframe, TrackedFrame | None] | None = None  # made; of which frame
        self._begins_at = np.eye(4)  # pose of a map's first camera, metres
        self._pending: LocalKeyframe | None = None  # the first keyframe, not yet handed out
        self._lens: Camera | None = None  # the camera as the backend has found it; None: to be looked for

    def look_only_at(self, shown: NDArray[np.bool_]) -> None:
        """Take no corners where ``shown`` (height, width), as large as all images to come, is False."""
        self._extractor.look_only_at(shown)

    def process(
        self, index: int, stamp_ns: int, grey: NDArray[np.uint8], camera: Camera, since_ns: int = 0
    ) -> FrameResult:
        """Track one image (height, width) taken at ``stamp_ns``; what is published follows from the result.

        ``since_ns``: after the image before it, be that a copy. :meth:`maybe_keyframe` comes after, so that a
        pose need not wait for the mapping.
        """
        if self._search.lapsed(since_ns) and self.initialised and not self._search.lost:
            self._lose(index, stamp_ns)  # it has gone on meanwhile, nobody knows where to
        lens = self._lens = found_lens(self.world.keyframes, camera, self._lens)
        view = View(lens, self._extractor.extract(grey, lens), stamp_ns)
        self.shutter.saw(view, camera.readout_ms, found_readout(self.world, lens))
        self.motion.saw(index, stamp_ns, self.shutter.least_s)
        self._fresh = None  # an older frame that nobody judged
        follow = self._continue if self.world.keyframes else self._begin
        self._result = follow(index, view)
        return self._result

    @property
    def last_result(self) -> FrameResult | None:
        """The result of the last frame, also that of an exact copy of it: where the map has it now."""
        result, pose = self._result, self.last_pose()
        if result is None or result.world_from_camera is None or pose is None:
            return result
        return replace(result, world_from_camera=pose, in_map=self.parts.at_home)

    @property
    def depth(self) -> float:
        """Median of what the keyframe that the camera is at sees, map units."""
        return self._at.depth

    def _begin(self, index: int, view: View) -> FrameResult:
        if len(view.features) >= MIN_FIRST_FEATURES and self.shutter.may_begin:
            self._pending = self._insert(index, view, self._begins_at)
            self.first.begin(self._pending.id, view.taken_ns)
            self._seen_at = self._began_at = view.taken_ns
        return nothing(INITIALISING)

    def _continue(self, index: int, view: View) -> FrameResult:
        frame, stamp_ns = self._track(view), view.taken_ns
        silent_s = 0.0 if self._seen_at is None else (stamp_ns - self._seen_at) * 1e-9
        self._extractor.want(0 if frame is None else frame.matched)
        if frame is None:
            if not self.initialised:
                if self.first.gives_way(stamp_ns):
                    self._restart(self._begins_at)
                return nothing(INITIALISING)
            if silent_s > self._config.lost_after_s and not self._search.lost:
                self._lose(index, stamp_ns)
            awaited = self.may_map and self._waiting is not None and self.first.awaits_answer
            self.wants_probe = self._search.lost and len(view.features) >= MIN_FIRST_FEATURES and not awaited
            if self._search.lost and self.may_map:
                self._look_on(index, view)
            # A map that was given up: the new one begins with the next frame, through the file's own lens.
            return nothing(INITIALISING if not self.initialised else LOST if self._search.lost else DEGRADED)
        if self._search.lost:
            log.info("found again at frame %d, %.1f s later", index, silent_s)
            self._settle(frame)
        self._update_motion(frame, stamp_ns)
        self.initialised = True
        self._fresh = (index, frame)
        return beside(self._reference(), frame, self.parts.at_home)

    def _lose(self, index: int, stamp_ns: int) -> None:
        self._search.begin(stamp_ns)
        self.motion.stop()
        self.places.begin()
        log.info("lost at frame %d", index)

    def _look_on(self, index: int, view: View) -> None:
        """Lost: a camera that has shown something for long, but nothing known, begins a new part of the map.

        It begins where the camera was last, so that `odom` goes on from there. A map younger than that
        patience knows neither scale nor shape: looked for as long as it was seen, it gives way to a new one.
        """
        shows, stamp_ns = len(view.features) >= MIN_FIRST_FEATURES, view.taken_ns
        self._search.look(stamp_ns, shows)
        if self._waiting is not None:
            if not self.first.gives_way(stamp_ns):
                return
            self.give_up_waiting()
        looked_s, patience_s = self._search.looked_s, self._config.submap_after_s
        last = self.last_pose()
        pose = self.world.newest().world_from_camera if last is None else last
        if self._age_s() <= looked_s and self._age_s() < patience_s:
            log.info("lost in a map of %.1f s, which is given up: a new one begins", self._age_s())
            self._restart(scaled(pose, math.exp(self.log_scale)))
            return
        if not (patience_s and looked_s >= patience_s and self._unmapped is None and shows):
            return
        if not self.parts.at_home and self.parts.size(self.world) == 1:
            # What was never seen from a second place: else what can't be tracked adds such parts for ever.
            take_out(self.world, self.parts, self.places, self.parts.newest(self.world))
        self.parts.begin(self._next_keyframe)
        self._pending = self._waiting = self._insert(index, view, pose)
        self.first.begin(self._waiting.id, stamp_ns)
        log.info("nothing is known here: a new part of the map begins at frame %d", index)

    def _age_s(self) -> float:
        """How long the map has been seen; infinite for one that was there before."""
        began, seen = self._began_at, self._seen_at
        return math.inf if began is None or seen is None else (seen - began) * 1e-9

    def give_up_waiting(self) -> None:
        """Forget the part that waits for its first depth, if any."""
        if self._waiting is not None and self._waiting.id in self.world.keyframes:
            take_out(self.world, self.parts, self.places, self._waiting)
        self._waiting = None

    def _settle(self, frame: TrackedFrame) -> None:
        """The camera was lost and is found."""
        self.give_up_waiting()
        self.parts.enter(self.world, frame.points[frame.points >= 0])
        self._search.lost = self.wants_probe = False
        self._at.leave()

    def _track(self, view: View) -> TrackedFrame | None:
        previous, frame, enough = self.last, None, self._config.min_matches
        if not (self.world.points.alive.any() and len(view.features) >= enough):
            return None
        self._frames.expected, self._frames.learns = None, not self._search.lost
        if self._search.lost:
            return self.places.attempt(self.world, self._frames, view, previous, enough)
        raw, stamp_ns, depth = view, view.taken_ns, self._at.depth
        if previous is not None:
            view = self.shutter.in_the_middle(raw, self.motion.twist, depth)
            moving = self.motion.predict(previous.world_from_camera, stamp_ns)
            if self.parts.size(self.world) > 1:  # one keyframe's points are all off together
                self._frames.expected = self.motion.expect(previous.world_from_camera, stamp_ns, depth)
            frame = self._frames.track_after(self.world, view, moving, previous, enough)
        if misled(frame, previous, enough):  # chance agrees with a few points: most of the looks know better
            found = recover(self.world, self._frames, view, self._reference(), enough, self._seed)
            frame, self._since_refresh = clearly_better(frame, found), REFRESH_FRAMES  # it chose other points
        if frame is None or frame.matched < enough:
            return None
        frame = look_again(self.world, self.parts, self._frames, frame, self._reference(), self._seed)
        twist = self.motion.since(self.last_pose(), frame.world_from_camera, stamp_ns)
        return self.shutter.placed(self.world, self._frames, frame, raw, twist, depth)

    def _update_motion(self, frame: TrackedFrame, stamp_ns: int) -> None:
        frame.world_from_camera = normalised(frame.world_from_camera)
        frame.unobserved = self._baselines.without(frame.unobserved, self.parts.current)
        pose, expected = frame.world_from_camera, frame.expected
        self.motion.follow(self.last_pose(), pose, stamp_ns, frame.covariance, expected)
        self.last, self._seen_at = frame, stamp_ns
        self._since_refresh += 1
        if self._since_refresh >= REFRESH_FRAMES:
            self._refresh(frame)

    def _refresh(self, frame: TrackedFrame) -> None:
        self._since_refresh = 0
        self._frames.refresh_local_map(self.world, frame.points[frame.points >= 0])

    def maybe_keyframe(self, judge: bool = True) -> LocalKeyframe | None:
        """Make the last frame a keyframe if it is worth one, where that is to be judged, or begins a map."""
        pending, self._pending = self._pending, None
        if pending is not None:
            self._unmapped = pending, None
        if pending is not None or self._fresh is None or not judge:
            return pending
        (index, frame), self._fresh = self._fresh, None
        stamp_ns, reference, at = self.motion.stamp_ns, self._reference(), self._at
        at.matches = max(at.matches, frame.matched)
        since_s = (stamp_ns - at.since_ns) * 1e-9
        reason = decide(self._config, frame, reference, since_s, at.matches, at.depth)
        if not reason:
            return None
        known = shown_before(self.world, frame, at.depth)
        if not self.may_map or (known is not None and not is_overdue(self.world, stamp_ns)):
            here = known or self.world.nearest(frame.points) or reference
            at.move_to(here, self.world, self.parts, stamp_ns)
            return None
        if self._config.two_views and self.parts.size(self.world) == 1:
            said = self.first.second_view(self.world, reference, frame, self._seed, stamp_ns)
            if said is SecondView.TOO_NEAR:
                return None
            if said is SecondView.CONTRADICTS:
                self.motion.stop()
                self._result = beside(reference, frame, self.parts.at_home)  # it is elsewhere now
        elif (  # a map that was there has been right before
            self._config.two_views and self._began_at is not None
            and is_contradicted(self.world, self.parts, frame, self._seed)
        ):
            self._restart(scaled(frame.world_from_camera, math.exp(self.log_scale)))
            return None
        view = View(frame.camera, frame.features, stamp_ns)
        keyframe = self._insert(index, view, frame.world_from_camera, frame.points.copy())
        mapping.introduce(self.world, keyframe)
        keyframe.twist, self._unmapped = self.motion.twist.copy(), (keyframe, frame)
        keyframe.stands_in = known is not None
        log.debug("keyframe %d at frame %d: %s", keyframe.id, index, reason)
        return keyframe

    def map_keyframe(self, meanwhile: Callable[[], None] = lambda: None) -> bool:
        """After :meth:`maybe_keyframe`: what a keyframe gives the map; False where that has gone meanwhile.

        ``meanwhile`` is called between one step and the next: it may track frames, which are to become no
        keyframes, and do nothing else with the tracker.
        """
        if self._unmapped is None:
            return True
        world, (keyframe, frame) = self.world, self._unmapped
        bounding = keeping_bound(world, self.parts, self.places, self._config)
        if frame is None:  # it begins its map or a part of it: a camera that is found meanwhile would drop it
            list(bounding)
            self._unmapped = None
            return True
        for _ in chain(mapping.extending(world, keyframe, self._extractor.scale_factors), bounding):
            meanwhile()
            if self.world is not world:
                return False
        self._unmapped, units = None, math.exp(-self.map_log_scale)
        adjust_unheard(world, self._config.adjust_unheard, units, self._frames.pose, self.last)
        frame.points = keyframe.points.copy()
        self._at.move_to(keyframe, world, self.parts, keyframe.stamp_ns)
        self._fresh = None
        self._refresh(frame if self.last is None else self.last)
        return True

    def _insert(self, index: int, view: View, pose: Array, points: Ids | None = None) -> LocalKeyframe:
        if points is None:  # it begins a map or a part: only corners can say how it moves
            view = self.shutter.without_map(view)
            points = np.full(len(view.features), -1, np.int64)
        keyframe = LocalKeyframe(
            self._next_keyframe, index, view.taken_ns, pose.copy(), view.camera, view.features, points
        )
        self._next_keyframe += 1
        self.world.add_keyframe(keyframe)
        self.parts.add(keyframe.id)
        self._at.renew(view.taken_ns)
        return keyframe

    def _reference(self) -> LocalKeyframe:
        return self._at.keyframe(self.world, self.parts)

    def add_depth(
        self, keyframe_id: int, depth: NDArray[np.float32], image_to_depth: Array, relative_sigma: float
    ) -> int:
        """Seed points from a keyframe's network depth (metres); returns how many."""
        if (keyframe := self.world.keyframes.get(keyframe_id)) is None:
            return 0
        first = (not self.initialised and self.last is None) or keyframe is self._waiting
        most = self._config.features if first or not self.initialised else self._config.features // 3
        # What begins a map or a part has the unit that it is published in.
        units = math.exp(-(self.log_scale if first else self.map_log_scale))
        ids = seed_from_depth(self.world, keyframe, depth, image_to_depth, units, relative_sigma, most)
        if first and len(ids) < self._config.min_matches:
            log.info("a first image's depth gives %d points: too few (tracking.min_matches)", len(ids))
            self.first.has_no_depth(keyframe_id)
        elif first:
            self.first.has_depth()
            if self._waiting is not None:  # a slow network is no reason to be lost again
                self._waiting, self._search.lost, self.wants_probe = None, False, False
                self._seen_at = self._search.at_ns
            self.last = TrackedFrame.of_keyframe(keyframe, len(ids))
            self._refresh(self.last)
            self.motion.stamp_ns = keyframe.stamp_ns
        self._since_refresh = REFRESH_FRAMES
        self._at.depth = self.world.median_depth(self._reference())
        return len(ids)

    def add_no_depth(self, keyframe_id: int) -> None:
        """What the network has for a keyframe is of no use."""
        self.first.has_no_depth(keyframe_id)
        if (keyframe := self.world.keyframes.get(keyframe_id)) is not None:
            seed_at_middle(self.world, keyframe, self._config.features // 3)
            self._since_refresh = REFRESH_FRAMES

    def recognise(self, keyframe: int, descriptor: F32, network: str = "") -> None:
        """Take the network's descriptor of a keyframe; below 0, of what a lost camera saw."""
        if keyframe in self.world.keyframes:
            self.places.add_place(keyframe, descriptor, network)
        elif keyframe < 0 and self._search.lost:
            self.places.heard(self.world, descriptor, network)

    def apply_update(self, update: MapUpdate) -> None:
        """Take over the backend's corrections; the last frame moves with its surroundings."""
        if len(update.camera):
            self._lens = Camera.from_array(PINHOLE, update.camera)
            see_through(self._lens, [*self.world.keyframes.values(), *([self.last] if self.last else [])])
        see_at_once(self.world, update.readout_ms, self.last, self.motion.twist, self._at.depth)
        if take_over(self.world, self.parts, update, self.last, self._frames.pose) and self.last is not None:
            self._refresh(self.last)

    def reset(self) -> None:
        """Begin a new map with the next frame: another epoch, at the identity."""
        self._restart(np.eye(4))
        self._seen_at, self.may_map = None, True

    def adopt(self, world: LocalMap, index: PlaceIndex, parts: Parts, epoch: int, log_scale: float) -> None:
        """Go on in a map that was there: the camera is looked for anywhere in it."""
        self.reset()
        self.world, self.places.index, self.parts = world, index, parts
        self.epoch, self.log_scale, self.map_log_scale = epoch, log_scale, log_scale
        self.initialised, self._began_at = True, None
        self._search.begin()
        world.announced = max(world.keyframes)
        self._next_keyframe = max(self._next_keyframe, beyond(world.announced))
        self.world.points.leave_room(self._next_keyframe)
        self._at.move_to(world.newest(), world, parts, world.newest().stamp_ns)

    def last_pose(self) -> Array | None:
        """world_from_camera of the last tracked frame as the map has it now."""
        return None if self.last is None else self.last.world_from_camera

    def _restart(self, at: Array) -> None:
        """Begin a new map, its first camera at a pose (4, 4) in metres."""
        self.world, self._lens, self._begins_at = LocalMap(self.shutter.found_ms), None, at
        self.places, self.parts, self._baselines = Relocaliser(self._seed), Parts(), Baselines()
        self._search.lost = self.wants_probe = self.initialised = False
        self.epoch += 1
        self.log_scale = self.map_log_scale = 0.0  # the next map's unit is fixed anew, by its first depth
        self.last = self._waiting = self._result = self._pending = self._unmapped = self._fresh = None
        self.motion.stop()
