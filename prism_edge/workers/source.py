"""The source worker: plays a recording, at its own pace or as fast as the others follow."""

from __future__ import annotations

import contextlib
import logging
import math
import time
from collections import deque
from dataclasses import replace

from prism_edge.bus.lockstep import Gatekeeper
from prism_edge.bus.pack import pack
from prism_edge.bus.session import Bus
from prism_edge.config import Config
from prism_edge.errors import SourceError
from prism_edge.geometry.unlikely_camera import doubts
from prism_edge.messages import EndOfStream, Frame
from prism_edge.named_path import named_path
from prism_edge.processes import LOADING_S, peers_of
from prism_edge.sources import Absent, Image, Slot, Source, Unreadable, open_source
from prism_edge.sources.checks import FrameChecks
from prism_edge.sources.live.open import check_mode
from prism_edge.sources.live.wall_clock import since_boot_ns
from prism_edge.sources.mask import mask_for
from prism_edge.sources.open import AUTO
from prism_edge.sources.own_parts_watch import OwnPartsWatch
from prism_edge.sources.schedule import GAP, CatchingUp, Schedule
from prism_edge.workers.cut_off import goes_on
from prism_edge.workers.pause import Pause
from prism_edge.workers.position import Before, Position, Sent

log = logging.getLogger("prism_edge.source")

_READING_S = 5.0  # a disk or network share that takes longer hangs
_TRUTH_FRAME = "simulated_world"
_GAP_NS = 5_000_000_000  # a pause in the stamps that is worth a line
# Lockstep: whoever takes longer over a frame died with it, and all wait for us.
_PATIENCE_S = 60.0
_LAST_S = 10.0  # for the tracker to say what it tracked last: on a busy machine it takes seconds
_AGAIN_S = 0.2  # between looks for who is not ready when the recording ends
_STILL_S = 2.0  # without a frame for this long, there is no rate
# Started again, it is known that there is a camera: it gets most of the time that a start may take.
_ABSENT_S = 45.0
_OPENING_S = 60.0  # and as long as a camera's last attempt takes
_ESTIMATING_S = 180.0  # a large network is loaded, and a slow computer runs it five times


class SourceWorker:
    """Joins a source to the bus."""

    def __init__(self, config: Config, bus: Bus, source: Source, patience_s: float = _PATIENCE_S) -> None:
        """``source`` is open."""
        self._config, self._bus, self._source = config, bus, source
        # Subscribed before we are ready: the others answer the first frame at once.
        self._peers = peers_of(config, "source")
        self._gatekeeper = Gatekeeper(bus, self._peers, patience_s) if config.is_lockstep else None
        self._pause = Pause(bus, self._show)
        self._checks = FrameChecks(source.camera)
        self._camera = source.camera.to_array()
        camera, mask = source.camera, config.source.mask  # the tracker's, but here is who knows the size
        size = camera.width, camera.height
        seen = mask_for(named_path(mask), *size, config.source.shrink) if mask else None
        self._own_parts = OwnPartsWatch(seen)
        bus.pulse.warn("camera file", "; ".join(f"camera: {doubt}" for doubt in doubts(source.camera)))
        self._last_index = -1
        self._position = Position(bus.run_directory)
        self._reported: set[str] = set()
        self._released_at: deque[float] = deque(maxlen=60)
        self._show()

    def run(self) -> None:
        """Says it is ready, waits for the others, plays, says that it has ended; stays until stopped."""
        self._bus.pulse.ready()
        self._await_peers()
        if self._bus.life and not self._source.live:
            self._resume()
        if not self._bus.life:
            self._pause.wait(self._config.source.wait_s)
        if self._source.live:
            self._play_live()
        elif self._gatekeeper is not None:
            self._play_lockstep(self._gatekeeper)
        else:
            self._play_realtime()
        if not self._bus.stopped.is_set():
            self._end()
        self._pause.wait(float("inf"))

    def _await_peers(self) -> None:
        """Until all whom the first frames are for listen and are linked to this process.

        In lockstep as long as a start here may take: without a network that loads, a run would be another.
        """
        config, waited = self._config, self._config.source.peers_s
        if waited == 0:
            return
        begun = bool(self._bus.life) or goes_on(self._bus)
        peers = awaited_peers(config, begun)
        starting = peers - set(config.network.remote) if config.is_lockstep else set()
        start_s = max(waited, config.supervisor.start_s + LOADING_S)
        missing = self._bus.await_ready(starting, start_s)
        missing |= self._bus.await_ready(peers - starting, waited)
        if missing and not self._bus.stopped.is_set():
            names = ", ".join(sorted(missing))
            log.warning("not ready in time: %s; playing all the same", names)

    def _resume(self) -> None:
        """Started again, a recording goes on after the last frame that was tracked."""
        last = self._last()
        if last is None:
            return
        index, _ = last
        log.info("going on after frame %d", index)
        while not self._bus.stopped.is_set():
            slot = self._source.peek()
            if slot is None or slot.index > index:
                return
            self._checks.earlier(self._source.leap(index) or self._source.skip())

    def _last(self) -> tuple[int, int] | None:
        """Index and stamp (ns) of the last image that was tracked, or went out if the tracker died too."""
        tracked, sent = self._bus.ask("tracked", _LAST_S), self._position.read()
        if tracked is not None:
            return tracked.index, tracked.stamp_ns
        return None if sent is None else (sent.index, sent.stamp_ns)

    def _play_live(self) -> None:
        """A camera: what it takes goes out at once; while it is away we say so, and wait for it."""
        before = Before.of(self._last(), self._position.read()) if self._bus.life else None
        first_index = 0 if before is None else before.index + 1
        shift_ns = 0 if before is None else None
        seen = 0
        while not self._bus.stopped.is_set():
            item = self._read()
            if item is None:
                return
            self._show()
            self._pause.serve()
            if isinstance(item, Absent):
                continue
            if self._pause.on:  # nor is there a number for what is held back: nobody has dropped it
                first_index, seen = first_index - (item.index + 1 - seen), item.index + 1
                continue
            for _ in range(item.index - seen):  # taken by the camera, and replaced by a newer one
                self._checks.late()
            seen = item.index + 1
            captured_ns = (isinstance(item, Image) and item.captured_monotonic_ns) or time.monotonic_ns()
            if shift_ns is None and before is not None:
                shift_ns = before.shift_ns(item.stamp_ns, captured_ns, self._source.period_ns)
            index, stamp_ns = first_index + item.index, item.stamp_ns + (shift_ns or 0)
            self._pass_on(replace(item, index=index, stamp_ns=stamp_ns), captured_ns)

    def _play_lockstep(self, gatekeeper: Gatekeeper) -> None:
        """The next image once everybody has done the last one and all that it caused."""
        while not self._bus.stopped.is_set():
            self._pause.serve()
            if self._pause.on:
                self._hold()
            start_ns = time.monotonic_ns()
            item = self._read()
            if item is None or isinstance(item, Absent):
                return
            if self._pass_on(item, start_ns):
                self._await_acknowledgements(gatekeeper, item.index)

    def _play_realtime(self) -> None:
        """Each image at its scheduled time; once that is late by more than a period, images are skipped.

        Where that gains no time (a video that decodes slowly) the schedule is put off instead.
        """
        # What is refused for its stamp can't be what the others are timed by.
        while (first := self._source.peek()) is not None and self._checks.refuses(first):
            item = self._read()
            if item is None or isinstance(item, Absent):
                return
            self._pass_on(item, time.monotonic_ns())
        if first is None:
            return
        schedule = Schedule(
            time.monotonic_ns(), first, self._source.period_ns, self._config.source.rate_hz
        )
        catching_up = CatchingUp()
        while (slot := self._source.peek()) is not None:
            self._source.read_ahead()
            # A stamp that is to be refused is due long ago or in a hundred years: it is taken at once.
            refused = self._checks.refuses(slot)
            if not self._sleep_until(0 if refused else schedule.due_ns(slot)):
                return
            if self._pause.on:
                schedule = schedule.put_off(self._hold())
                continue
            now_ns = time.monotonic_ns()
            if not refused and schedule.is_late(slot, now_ns):
                if self._gains(catching_up, slot.index, schedule.periods_late(slot, now_ns)):
                    if self._source.skip():
                        self._checks.late()
                    self._show()
                    continue
                schedule = schedule.put_off(now_ns - schedule.due_ns(slot))
            item = self._read()
            if item is None or isinstance(item, Absent):
                return
            # Where the stamp was a guess until now (video), the true one may lie ahead.
            due_ns = now_ns if refused else schedule.due_ns(Slot(item.index, item.stamp_ns))
            if not self._sleep_until(due_ns):
                return
            if self._pause.on:  # since it was read
                held_ns = self._hold()
                schedule, due_ns = schedule.put_off(held_ns), due_ns + held_ns
                if self._bus.stopped.is_set():
                    return
            self._pass_on(item, due_ns)

    def _gains(self, catching_up: CatchingUp, index: int, late: float) -> bool:
        """Whether to skip the late image; says once where that is of no use."""
        if not self._source.decodes_skipped or catching_up.skips(index, late):
            return True
        if "slow" not in self._reported:
            self._reported.add("slow")
            why = "decoding takes longer than the video's own pace leaves"
            log.warning("%s: it is played slower (use lockstep, or a smaller video)", why)
        return False

    def _sleep_until(self, due_ns: int) -> bool:
        """False where the process is to stop instead."""
        ahead_ns = due_ns - time.monotonic_ns()
        if ahead_ns > 0:
            self._bus.pulse.idle()
            if ahead_ns > _GAP_NS:
                log.warning("the stamps pause: the next image is due in %.1f s", ahead_ns / 1e9)
                self._bus.pulse.values[GAP] = f"{ahead_ns / 1e9:.1f}"
        self._pause.wait(ahead_ns / 1e9)
        self._bus.pulse.values.pop(GAP, None)
        return not self._bus.stopped.is_set()

    def _hold(self) -> int:
        """Wait while paused; how many nanoseconds."""
        self._bus.pulse.idle()
        self._show()
        held_ns = self._pause.hold()
        self._show()
        return held_ns

    def _read(self) -> Image | Unreadable | Absent | None:
        self._bus.pulse.working("reading", _READING_S)
        return self._source.read()

    def _pass_on(self, item: Image | Unreadable, captured_ns: int) -> bool:
        """Publishes the item if it passes the checks; False where it is refused."""
        verdict = self._checks.check(item)
        if not verdict.released or isinstance(item, Unreadable):
            if verdict.kind not in self._reported:
                self._reported.add(verdict.kind)
                log.warning("not released: %s (more of the kind are only counted)", verdict.reason)
            self._show()
            return False
        image, colour = pack(item.pixels)
        readout_ms = self._source.camera.readout_ms
        frame = Frame(
            index=item.index,
            stamp_ns=item.stamp_ns,
            captured_monotonic_ns=captured_ns,
            colour=colour,
            duplicate=verdict.duplicate,
            camera_model=self._source.camera.model,
            camera=self._camera,
            image=image,
            readout_ms=math.nan if readout_ms is None else readout_ms,
        )
        self._bus.publish("frame", frame)
        self._position.note(Sent(frame.index, frame.stamp_ns, since_boot_ns(captured_ns)))
        true_pose = self._source.true_pose(item.index)
        if true_pose is not None:
            from prism_edge.bus import ros  # slow to load, and recordings have no need of it

            self._bus.publish("truth", ros.pose_stamped(item.stamp_ns, _TRUTH_FRAME, true_pose))
        self._own_parts.look(item.pixels, item.stamp_ns)
        self._last_index = item.index
        self._released_at.append(time.monotonic())
        self._show()
        return True

    def _await_acknowledgements(self, gatekeeper: Gatekeeper, index: int) -> None:
        self._bus.pulse.idle()
        missing = gatekeeper.wait(index)
        if missing and not self._bus.stopped.is_set():
            names = ", ".join(sorted(missing))
            log.warning("frame %d was not acknowledged by %s: going on without", index, names)

    def _show(self) -> None:
        counts = self._checks.counts
        shown = ("frames", "released", "duplicates", "unreadable", "wrong_size", "bad_stamps", "skipped")
        self._bus.pulse.values.update({name: str(getattr(counts, name)) for name in shown})
        times = self._released_at
        flows = len(times) > 1 and time.monotonic() - times[-1] < _STILL_S
        rate = (len(times) - 1) / (times[-1] - times[0]) if flows else 0.0
        health, pulse = dict(self._source.health()), self._bus.pulse
        pulse.warn("own parts", self._own_parts.warning)
        pulse.warn("camera", health.pop("warning", ""))
        pulse.warn("pause", self._pause.warning)
        pulse.values.update(health | {"fps": f"{rate:.1f}"})

    def _end(self) -> None:
        counts = self._checks.counts
        end = EndOfStream(
            frames=counts.frames,
            released=counts.released,
            duplicates=counts.duplicates,
            unreadable=counts.unusable,
            last_index=self._last_index,
        )
        late = self._bus.await_ready(self._peers, 0.0)
        self._bus.publish("end", end)
        self._bus.pulse.ended()
        log.info("the recording has ended: %s", ", ".join(f"{n} {name}" for name, n in vars(counts).items()))
        while late and not self._bus.stopped.is_set():
            self._pause.wait(_AGAIN_S)
            late = self._bus.await_ready(late, 0.0)
            if not late:  # who was not linked by then has not heard of it, and the run would go on for ever
                self._bus.publish("end", end)


def awaited_peers(config: Config, begun: bool) -> set[str]:
    """The processes without which no image goes out; ``begun`` where there may be a map to track in.

    Then the tracker will do, in real time: others may be loading a network, or waiting to be started again.
    And what runs on another computer, which may be off, is waited for by nobody.
    """
    peers = peers_of(config, "source")
    if config.is_lockstep:
        return peers
    return peers & {"tracker"} if begun else peers - (set(config.network.remote) - {"tracker"})


def main(config: Config, bus: Bus) -> None:
    """Runs until ``bus.stopped``; raises SourceError or ConfigError where there is nothing to play."""
    bus.pulse.working("opening the source", _OPENING_S)
    absent_s = max(config.source.absent_s, _ABSENT_S if bus.life else 0.0)
    config = replace(config, source=replace(config.source, absent_s=absent_s))
    check_mode(config)
    source = open_source(config.source)
    if config.source.camera == AUTO:
        from prism_edge.workers.uncalibrated import estimated_camera  # brings onnxruntime along

        bus.pulse.working("estimating the camera", _ESTIMATING_S)
        try:
            source.camera_origin, source.camera = estimated_camera(config, bus.stopped)
        except SourceError:
            if bus.stopped.is_set():  # before there was an image
                return
            raise
        bus.pulse.working("opening the source", _OPENING_S)
    source.stop_on(bus.stopped)
    if source.live:
        bus.pulse.working("opening the camera", _OPENING_S + source.connecting_s)
    with contextlib.ExitStack() as stack:
        try:
            stack.enter_context(source)
        except SourceError:
            if bus.stopped.is_set():  # it had only begun to wait for its camera
                return
            raise
        log.info("%s; camera: %s", source.name, source.camera_origin)
        for doubt in doubts(source.camera):
            log.warning("camera: %s", doubt)
        SourceWorker(config, bus, source).run()
