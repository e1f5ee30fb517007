"""The tracker worker: frames in, poses out at camera rate, keyframes for the others."""

from __future__ import annotations

import gc
import logging
import time
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np

from prism_edge.bus.commands import Reply, on_or_off
from prism_edge.bus.pack import grey
from prism_edge.bus.session import Bus
from prism_edge.config import Config
from prism_edge.geometry.cameras import Camera
from prism_edge.geometry.mount import base_from_camera, described
from prism_edge.geometry.poses import Array
from prism_edge.messages import (
    INITIALISING,
    LOOP_CLOSED,
    LOST,
    RECOVERED,
    Acknowledged,
    Depth,
    Epoch,
    Frame,
    MapUpdate,
    Scale,
    Tracked,
    WholeMap,
)
from prism_edge.processes import peers_of
from prism_edge.tracking.announcement import keyframe_message
from prism_edge.tracking.drift import Drift
from prism_edge.tracking.local_map import LocalKeyframe
from prism_edge.tracking.map_correction import flaw
from prism_edge.tracking.odometry import MetricOdometry
from prism_edge.tracking.scale_here import ScaleHere
from prism_edge.tracking.tracker import FrameResult, Tracker
from prism_edge.tracking.unseen import Sight
from prism_edge.workers.ablated import tracking_of
from prism_edge.workers.answers_due import PATIENCE_S, AnswersDue
from prism_edge.workers.clock_behind import ClockBehind
from prism_edge.workers.cut_off import goes_on
from prism_edge.workers.frame_camera import FrameCamera
from prism_edge.workers.keeping_up import KeepingUp
from prism_edge.workers.map_adoption import MapAdoption
from prism_edge.workers.pictures import Pictures
from prism_edge.workers.pose_publisher import PosePublisher
from prism_edge.workers.tracker_status import TrackerStatus

log = logging.getLogger("prism_edge.tracker")

_LOOK_S = 0.02  # between frames, for what the others have sent
_FRAME_S = 5.0
_MOST_BETWEEN = 2  # frames tracked while a keyframe joins the map: more would put that off for long
SEED_DEPTH_SIGMA = 0.2  # relative error of one pixel of network depth


class TrackerWorker:
    """Joins the tracker to the bus."""

    def __init__(self, config: Config, bus: Bus) -> None:
        self._bus = bus
        self._lockstep = config.is_lockstep
        self._peers = peers_of(config, "tracker")
        self._frames = bus.queue("frame", 64) if self._lockstep else bus.latest("frame")
        # In real time these are taken in while there is no frame to track: none need wait for them.
        other = None if self._lockstep else self._frames
        self._inboxes = {name: bus.queue(name, rouses=other) for name in ("depth", "log_scale", "map_update")}
        self._maps = MapAdoption(config, bus)
        self._ends = bus.queue("end")
        self._tracker = Tracker(tracking_of(config), config.seed, bus.first_id)
        self._camera = FrameCamera(bus.pulse, config.source.mask, config.source.shrink)
        if self._camera.shown is not None:
            self._tracker.look_only_at(self._camera.shown)
        self._odometry, self._sight = MetricOdometry(), Sight()
        errors = config.covariance
        self._publisher = PosePublisher(bus, config.frames, errors.refinement, errors.moment_ms * 1e-3)
        self._drift, self._status = Drift(errors), TrackerStatus(bus)
        self._scale = ScaleHere(self._tracker, self._odometry, self._drift)
        self._update_sequence, self._clock_behind = -1, ClockBehind(bus.pulse)
        self._answers = AnswersDue(bus, self._inboxes, self._peers, config.lockstep)
        self._last_index, self._dropped, self._between = -1, 0, 0
        self._keeping_up = KeepingUp(bus.pulse)
        self._pictures = Pictures(bus, "depth" in self._peers, base_from_camera(config.frames))
        self._now_ns = 0  # stamp of the newest frame
        # The map of a run that was cut off: the first image says whether it is this camera's.
        self._unproven = self._recovering = self._ending = self._localise_only = False
        self._desk = bus.commands({"reset": self._reset, "localise_only": self._switch_localise_only})
        bus.answer("epoch", lambda: Epoch(self._tracker.epoch))

    def run(self) -> None:
        """Tracks until the bus is stopped."""
        if self._bus.first_id and not self._lockstep:  # one started by hand may be a later life
            adopted = self._adopt(self._maps.of_the_last_life())
            self._unproven = adopted and not self._bus.life
        elif goes_on(self._bus) and not self._lockstep:
            self._unproven = self._adopt(self._maps.of_a_run_cut_off())
            if not self._unproven:
                self._tracker.reset()  # a later epoch than any map that the backend may have found after all
        self._bus.pulse.ready()
        if self._lockstep:
            self._bus.await_ready(self._peers, PATIENCE_S)
        self._show(self._so_far(), 0, time.time_ns())
        while not self._bus.stopped.is_set():
            # Loaded first: a command that waits beside it was most likely given once that had been done.
            self._maps.take_loaded(self._tracker, self._adopt_loaded, self._reset)
            self._desk.serve()
            frame = self._frames.take(_LOOK_S)
            if frame is not None:
                self._bus.pulse.working(f"frame {frame.index}", _FRAME_S)
                self._take_in(frame.index)
                self._track(frame)
                if self._lockstep:
                    self._bus.publish("acknowledged", Acknowledged("tracker", frame.index))
                self._bus.pulse.idle()
            else:
                if not self._lockstep:
                    self._take_in(-1)
                self._status.repeat()
                self._note_end()

    def _note_end(self) -> None:
        self._ending |= bool(self._ends.drain())
        if self._ending:  # again after a frame that came behind it
            self._bus.pulse.ended()

    # -- one frame --------------------------------------------------------------------------------

    def _track(self, frame: Frame, judge: bool = True) -> None:
        """All that becomes of a frame; without ``judge`` no keyframe but one that begins a map."""
        # A copy of what was released before it, which may have been dropped: then it is news.
        follows = frame.index == self._last_index + 1
        counts = self._last_index >= 0 or not self._bus.first_id  # while we were down, we dropped nothing
        dropped = max(frame.index - self._last_index - 1, 0) if counts else 0
        self._dropped += dropped
        since_ns, self._last_index, self._now_ns = frame.stamp_ns - self._now_ns, frame.index, frame.stamp_ns
        camera = self._camera.of(frame)
        if camera is None:
            self._tick(frame, self._so_far(), published=False)
            return
        self._keeping_up.saw(frame.stamp_ns, dropped, camera)
        if self._unproven:
            self._prove(camera)
        tracker, before = self._tracker, self._tracker.last_pose()
        last = tracker.last_result if frame.duplicate and follows else None
        # A camera that shows the same darkness for long is lost like any other; a first map's depth is news.
        repeated = last is not None and (
            last.world_from_camera is not None
            or (last.odometry == INITIALISING and not len(tracker.world.points))
        )
        if last is None or not repeated:
            last = tracker.process(frame.index, frame.stamp_ns, grey(frame), camera, since_ns)
            self._scale.enter()
        result = last
        published = result.world_from_camera is not None and result.in_map
        if self._recovering and published:
            self._recovering = False
            self._status.say(RECOVERED, tracker.epoch, frame.stamp_ns)
        if result.world_from_camera is not None:
            self._publish(frame, result, before, repeated)
        else:
            self._sight.miss(result.odometry)
        keyframe = None if repeated else tracker.maybe_keyframe(judge)
        if keyframe is not None:
            self._drift.add_keyframe(tracker.world, keyframe, tracker.log_scale)
            result = tracker.last_result or result  # it may have moved the frame
        made = -1 if keyframe is None else keyframe.id
        # A keyframe is shown anyway, and in lockstep one picture a frame is waited for.
        probe = made < 0 and not repeated and tracker.wants_probe and self._probe(frame)
        reference, offset = result.reference, result.reference_from_camera
        self._tick(frame, result.odometry, published, made, reference, offset, probe)
        self._show(result.odometry, result.matched, frame.stamp_ns)
        if keyframe is None:
            if not self._lockstep:
                self._pictures.once_more(frame.stamp_ns, self._status.metres)
            return
        travelled, self._between = self._drift.travelled, 0
        if tracker.map_keyframe(self._track_waiting):
            self._announce(keyframe, frame, travelled)

    def _track_waiting(self) -> None:
        """A keyframe takes longer to join the map than some frames can wait."""
        if self._lockstep or self._between == _MOST_BETWEEN:
            return
        waiting = self._frames.take()
        if waiting is not None:
            self._between += 1
            self._track(waiting, judge=False)

    def _tick(
        self, frame: Frame, odometry: str, published: bool, keyframe: int = -1, reference: int = -1,
        reference_from_camera: Array | None = None, probe: bool = False,
    ) -> None:
        """Tell the others what became of a frame."""
        self._bus.publish(
            "tracked",
            Tracked(
                frame.index,
                frame.stamp_ns,
                frame.captured_monotonic_ns,
                odometry,
                published,
                keyframe,
                reference,
                np.eye(4) if reference_from_camera is None else reference_from_camera,
                self._dropped,
                probe,
                self._scale.sigma,
                *self._drift.here.sigmas(),
                *self._drift.total.sigmas(),
            ),
        )

    def _publish(self, frame: Frame, result: FrameResult, before: Any, repeated: bool) -> None:
        assert result.world_from_camera is not None
        tracker = self._tracker
        if repeated:
            self._odometry.repeat(frame.stamp_ns)
        else:
            began_ns = tracker.world.keyframes[result.reference].stamp_ns
            unseen = self._sight.see(tracker.epoch, tracker.parts.current, began_ns, frame.stamp_ns)
            if unseen.lost:
                self._odometry.lose()
            if unseen.unseen_s:
                self._drift.miss(unseen.unseen_s)
            step = before, result.world_from_camera, tracker.log_scale, frame.stamp_ns
            self._odometry.advance(*step, tracker.motion.pace.longest_s)
            self._drift.advance(before, result, tracker.log_scale, frame.stamp_ns, tracker.depth)
        self._publisher.publish(
            frame.stamp_ns,
            result,
            self._odometry,
            tracker.log_scale,
            self._scale.sigma,
            self._scale.odom_error,
            self._drift.here,
            self._drift.total,
            self._maps.mount(tracker.epoch),
        )

    def _probe(self, frame: Frame) -> bool:
        """Show the depth worker what a lost camera sees, now and then; whether this frame was shown."""
        picture = self._pictures.probe(frame, self._tracker.epoch)
        if picture is not None and self._lockstep:
            self._answers.probe(frame.index, picture.keyframe)
        return picture is not None

    def _announce(self, keyframe: LocalKeyframe, frame: Frame, travelled: float) -> None:
        mount = self._maps.mount(self._tracker.epoch)
        self._bus.publish("keyframe", keyframe_message(self._tracker, keyframe, travelled, mount))
        self._pictures.keyframe(frame, keyframe.id, self._tracker.epoch, self._status.metres)
        if self._lockstep:
            self._answers.keyframe(frame.index, keyframe.id)

    # -- what the others send ---------------------------------------------------------------------

    def _take_in(self, index: int) -> None:
        """Apply what has arrived; in lockstep exactly what is due at frame ``index``, waiting for it."""
        apply: dict[str, Callable[[Any], None]] = {
            "depth": self._apply_depth,
            "log_scale": self._apply_scale,
            "map_update": self._apply_update,
        }
        if self._lockstep:
            for topic, message in self._answers.take(index):
                apply[topic](message)
            return
        for topic, inbox in self._inboxes.items():
            for message in inbox.drain():
                apply[topic](message)

    def _apply_depth(self, message: Depth) -> None:
        self._tracker.first.heard(message.keyframe)  # of whatever map
        if message.epoch != self._tracker.epoch:
            return
        self._tracker.recognise(message.keyframe, message.descriptor, message.model)
        if message.keyframe < 0:
            return
        self._status.metres.depth(message.keyframe, message.valid, message.reason)
        if not message.valid:
            self._tracker.add_no_depth(message.keyframe)
            return
        sigma = float(np.hypot(SEED_DEPTH_SIGMA, message.bias_sigma if message.says_bias else 0.0))
        self._tracker.add_depth(message.keyframe, message.depth, message.image_to_depth, sigma)

    def _apply_scale(self, message: Scale) -> None:
        numbers = (message.log_scale, message.map_log_scale, message.sigma, message.local_sigma)
        if message.epoch != self._tracker.epoch:
            return
        self._status.metres.scale(message.keyframe, message.observation, message.accepted)
        # One that was started again and knows nothing yet takes nothing from what was known.
        if message.metric and np.isfinite(numbers).all():
            self._scale.hear(message)

    def _apply_update(self, message: MapUpdate) -> None:
        if message.epoch != self._tracker.epoch:
            return  # of a map that is gone
        self._clock_behind.saw(message.sequence - self._update_sequence)
        if message.sequence <= self._update_sequence:
            return  # overtaken
        problem = flaw(message)
        if problem:
            if self._bus.pulse.count("malformed") == 1:
                log.warning("map update %d is passed over: %s", message.sequence, problem)
            return
        self._update_sequence = message.sequence
        if len(message.keyframes):
            self._tracker.apply_update(message)
            self._scale.enter()
        if message.loop_query >= 0:
            self._drift.close(self._tracker.world, message, self._tracker.log_scale)
            self._status.say(LOOP_CLOSED, self._tracker.epoch, self._now_ns)

    def _adopt(self, whole: WholeMap | None) -> bool:
        """Go on in the backend's map, if there is one to go on in."""
        if whole is None or not self._maps.take_over(self._tracker, whole):
            return False
        self._scale.begin(whole.scale_sigma)
        self._update_sequence = whole.sequence
        self._drift.travelled = self._maps.travelled
        self._tracker.may_map = not self._localise_only
        self._drift.forget()
        self._answers.forget()
        return True

    def _adopt_loaded(self, whole: WholeMap | None) -> bool:
        adopted = self._adopt(whole)
        if adopted:
            self._unproven = self._recovering = False  # this one is no earlier run's, whoever made it
            self._bus.forget("tf")  # where the camera is in this map nobody knows yet
            self._show_now(LOST)
        return adopted

    def _prove(self, camera: Camera) -> None:
        """Go on in the map of an earlier run only with the camera that made it."""
        self._unproven = False
        if self._tracker.world.newest().camera.like(camera):
            self._recovering = goes_on(self._bus)
            return
        log.warning("the map that was left was made by another camera: a new one begins")
        self._reset("")

    # -- commands ---------------------------------------------------------------------------------

    def _reset(self, argument: str) -> Reply:
        self._tracker.reset()
        self._answers.forget()
        self._scale.begin()
        self._drift.travelled, self._localise_only = 0.0, False
        self._unproven = self._recovering = False  # there is nothing left of an earlier run's map
        self._bus.publish("new_map", Epoch(self._tracker.epoch))
        self._bus.forget("tf")  # it led into the map that is gone
        self._show_now(INITIALISING)
        return Reply(True, "a new map begins with the next image, and is built on; odom goes on")

    def _switch_localise_only(self, argument: str) -> Reply:
        wanted = on_or_off(argument)
        if wanted and not self._tracker.initialised:
            return Reply(False, "there is no map to localise in yet")
        self._localise_only, self._tracker.may_map = wanted, not wanted
        if wanted:
            self._tracker.give_up_waiting()  # its part could never grow
        self._show_now(self._so_far())
        return Reply(True, "the map stays as it is" if wanted else "the map is built on")

    def _so_far(self) -> str:
        last, lacking = self._tracker.last_result, LOST if self._tracker.initialised else INITIALISING
        return lacking if last is None else last.odometry

    def _show_now(self, odometry: str) -> None:
        """What a command has changed, as it may be long until the next image: the camera may be paused."""
        self._show(odometry, 0, self._now_ns or time.time_ns())

    def _show(self, odometry: str, matched: int, stamp_ns: int) -> None:
        tracker, kept = self._tracker, self._localise_only
        values = {
            "matched": matched,
            "keyframes": len(tracker.world.keyframes),
            "points": int(tracker.world.points.alive.sum()),
            "scale_sigma": f"{self._scale.sigma:.4f}",
            "dropped": self._dropped,
        }
        self._status.show(tracker.epoch, odometry, tracker.parts.at_home, kept, stamp_ns, values)


def main(config: Config, bus: Bus) -> None:
    """Runs until ``bus.stopped``."""
    cv2.setNumThreads(1)
    log.info("%s", described(config.frames))
    worker = TrackerWorker(config, bus)
    # Every frame makes thousands of short-lived keypoint objects: they are no reason to search for cycles.
    gc.freeze()
    gc.set_threshold(200_000, 20, 100)
    worker.run()
