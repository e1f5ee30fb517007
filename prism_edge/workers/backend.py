"""The backend worker: keyframes and their depth in, corrections of the map out."""

from __future__ import annotations

import logging
import time
from dataclasses import replace

import numpy as np

from prism_edge.backend.loop_closing import Accepted
from prism_edge.backend.map_scale import KnownScale
from prism_edge.backend.mapper import Mapper
from prism_edge.backend.part_units import PartUnits
from prism_edge.bus.commands import Reply
from prism_edge.bus.session import Bus
from prism_edge.config import Config
from prism_edge.messages import (
    HOME,
    Acknowledged,
    Depth,
    Keyframe,
    MapLoaded,
    MapUpdate,
    Solved,
    Tracked,
    WholeMap,
)
from prism_edge.processes import peers_of
from prism_edge.workers.arrivals import Arrivals
from prism_edge.workers.handover import Handover
from prism_edge.workers.loaded_map import LoadedMap
from prism_edge.workers.map_health import show_map
from prism_edge.workers.map_keeper import MapKeeper
from prism_edge.workers.map_snapshot import snapshot
from prism_edge.workers.shutter_watch import ShutterWatch

log = logging.getLogger("prism_edge.backend")

_LOOK_S = 0.05
_SOLVE_S, _ADJUST_S = 20.0, 60.0  # gtsam may try a step of a global adjustment a dozen times
_ASK_S = 2.0
_PATIENCE_S = 30.0  # lockstep: a keyframe or depth that takes longer isn't coming
_LOCKSTEP_STEPS = 3  # of a global adjustment with each keyframe, so that its end comes a fixed number later


class BackendWorker:
    """Joins the mapper to the bus."""

    def __init__(self, config: Config, bus: Bus) -> None:
        self._bus, self._peers = bus, peers_of(config, "backend")
        self._use_depth = "depth_factor" not in config.ablate and "depth" in self._peers
        self._close_loops = config.backend.loops and "loop" not in config.ablate
        self._keyframes = bus.queue("keyframe", 64)
        self._depths = bus.queue("depth", 64)
        self._scales = bus.queue("log_scale", 64)
        self._gates = bus.queue("gate", 64)
        self._ends, self._begun = bus.queue("end"), bus.queue("new_map")
        self._ticks = bus.queue("tracked", 1024) if config.is_lockstep else None
        use_rays = "plucker" not in config.ablate
        settings = replace(config.backend, lens=config.backend.lens and "lens" not in config.ablate)
        self._mapper = Mapper(settings, self._use_depth, bus.first_id, config.seed, use_rays)
        self._home_scale, self._units = KnownScale(), PartUnits()  # of the map's first part; of all
        self._keeper = MapKeeper(config, bus, self._mapper, self._units)
        self._loaded = LoadedMap(bus, self._mapper)
        self._desk = bus.commands({"save_map": self._save_map, "load_map": self._load_map})
        self._whole = Handover()
        self._shutter = ShutterWatch(self._mapper, bus.pulse, config.backend.shutter)
        self._arrivals = Arrivals(self._peers, self._use_depth)
        self._unsolved: Keyframe | None = None  # absorbed for who asked for the map
        self._late: int | None = None  # the newest keyframe whose descriptor came after it was looked at
        self._settled, self._adjusting_since_ns = False, 0
        recovered = self._keeper.recover()
        if recovered is not None:
            self._home_scale = recovered
        # A whole run's map, not a life's: the new scale filter does not know its unit.
        self._untold = recovered is not None and not bus.life
        self._show()
        bus.answer("map_snapshot", lambda: self._snapshot)
        bus.answer("whole_map", self._whole.ask)
        bus.answer("map_loaded", self._known_unit)

    def run(self) -> None:
        """Works until the bus is stopped; the map stays available."""
        self._bus.pulse.ready()
        if self._ticks is not None:
            self._bus.await_ready(self._peers, _PATIENCE_S)
        ending = False
        while not self._bus.stopped.is_set():
            self._desk.serve()
            self._whole.serve(self._whole_map)
            if self._untold and not self._bus.await_ready(self._peers & {"scale"}, _LOOK_S):
                self._untold = False
                self._loaded.tell(self._home_scale)
            worked = self._realtime() if self._ticks is None else self._lockstep()
            ending = ending or bool(self._ends.drain())
            # The last keyframe may still be under way when the end is: one quiet look more.
            if ending and not worked and not self._arrivals and not self._settled:
                self._receive(4 * _LOOK_S)
                if self._late is None:
                    self._settle()
        self._keeper.tidy(self._home_scale)  # where it is only this process that is started again

    def _settle(self) -> None:
        """Adjust what is still to be adjusted; the end has been reached where nothing comes meanwhile."""
        loops, bent = self._mapper.loops, True
        while bent:
            loops.finish()
            while loops.unfinished and not self._arrivals and not self._bus.stopped.is_set():
                self._adjust()
            idle = not (self._arrivals or self._bus.stopped.is_set())
            if bent := idle and bool(self._shutter.look(ended=True)):
                self._tell_whole()
        if not self._arrivals:
            self._keeper.tidy(self._home_scale)
            self._settled = True
            self._show()
            self._rest()

    def _tidy(self) -> None:
        if taken := self._shutter.look():  # in lockstep it has been looked at with its newest keyframe
            self._tell_whole()
        if self._keeper.tidy(self._home_scale) or taken is not None:
            self._rest()

    def _rest(self) -> None:
        """Nothing to do for now; `run` waits until that is said to be for good."""
        if self._settled:
            self._bus.pulse.ended()
        else:
            self._bus.pulse.idle()

    # -- real time ----------------------------------------------------------------------------------

    def _realtime(self) -> bool:
        """Absorb every keyframe at once, solve the window of the newest, or look at one again.

        Whether there was one.
        """
        self._receive(0.0 if self._mapper.loops.adjusting else _LOOK_S)
        newest, self._unsolved = self._unsolved, None
        while (keyframe := self._arrivals.next(patient=True)) is not None:
            self._absorb(keyframe)
            newest = keyframe
        late = self._late
        if newest is not None:
            self._solve(newest)
        elif late is not None:
            self._look_again(late)
        else:
            self._tidy()
            if self._mapper.loops.adjusting:
                self._adjust()
        return newest is not None or late is not None

    def _receive(self, timeout_s: float) -> None:
        first = self._keyframes.take(timeout_s)
        if self._ticks is None:  # else between keyframes, for each of which all wait
            self._hear_of_new_maps()
        for keyframe in ([first] if first is not None else []) + self._keyframes.drain():
            if keyframe.epoch >= self._mapper.epoch:
                self._arrivals.keyframe(keyframe)
            else:
                self._arrivals.is_gone(keyframe)
                self._loaded.remind(self._home_scale)
        late = set()
        for depth in self._depths.drain():
            self._keeper.heard_network = depth.model or self._keeper.heard_network
            if depth.epoch == self._mapper.epoch and depth.keyframe in self._mapper.world.keyframes:
                if self._take_late(depth):
                    late.add(depth.keyframe)
            elif depth.keyframe >= 0:  # else a probe's, which is for the tracker
                self._arrivals.depth(depth)
        for gate in self._gates.drain():
            self._arrivals.gate(gate)
            self._mapper.add_gate(gate)
            if gate.epoch == self._mapper.epoch and gate.keyframe in self._mapper.world.keyframes:
                late.add(gate.keyframe)
        for scale in self._scales.drain():
            self._arrivals.scale(scale.keyframe)
            # A scale process that knows nothing yet takes nothing from what is known here.
            numbers = scale.log_scale, scale.map_log_scale
            if scale.epoch == self._mapper.epoch and scale.metric and np.isfinite(numbers).all():
                self._units.hear(scale)
                if scale.part == HOME:  # what is kept, and told to others, is of that one's unit
                    told = scale.log_scale, scale.known_to, scale.bias_sigma, scale.network
                    self._home_scale = KnownScale(*told, scale.lost_sigma)
        for number in sorted(late):
            self._keeper.note_late(number, self._home_scale)

    def _take_late(self, depth: Depth) -> bool:
        """Depth that its keyframe has not waited for serves the windows and loops that are still to come.

        Whether it had anything for them.
        """
        useful = depth.valid and self._use_depth
        if useful:
            self._mapper.add_late_depth(depth, self._units.log_scale)
        if not self._close_loops:
            return useful
        known = self._mapper.loops.add_place(depth.keyframe, depth.descriptor, depth.model)
        if known and self._ticks is None:  # in lockstep nothing is late but what had no time limit
            self._late = max(depth.keyframe, -1 if self._late is None else self._late)
        return useful or known

    def _hear_of_new_maps(self) -> None:
        for told in self._begun.drain():
            if told.epoch > self._mapper.epoch:
                self._begin(told.epoch)

    def _begin(self, epoch: int) -> None:
        """A new map, of which nothing is there yet: nobody is to go on in the one before."""
        self._mapper.begin(epoch)
        self._home_scale = KnownScale()
        self._arrivals.begin(epoch)
        self._unsolved = self._late = None
        self._untold = False
        self._keeper.forget()
        self._show()

    def _absorb(self, keyframe: Keyframe) -> None:
        if keyframe.epoch != self._mapper.epoch:
            self._begin(keyframe.epoch)
        self._settled = False
        self._mapper.absorb(keyframe)
        depth, gate = self._arrivals.take(keyframe.id)
        if gate is not None:
            self._mapper.add_gate(gate)
        if depth is not None and depth.valid and depth.epoch == keyframe.epoch and self._use_depth:
            self._mapper.add_depth(keyframe, depth, self._units.log_scale)
        if depth is not None and depth.epoch == keyframe.epoch and self._close_loops:
            self._mapper.loops.add_place(keyframe.id, depth.descriptor, depth.model)
        self._keeper.note(keyframe, self._home_scale)

    def _solve(self, keyframe: Keyframe) -> MapUpdate | None:
        budget_s = _SOLVE_S if self._ticks is None else _ADJUST_S  # in lockstep it has steps of both
        self._bus.pulse.working(f"window of keyframe {keyframe.id}", budget_s)
        loops, adjusted = self._mapper.loops, False
        if self._ticks is not None:
            for _ in range(_LOCKSTEP_STEPS):
                if loops.adjusting and not adjusted:
                    adjusted = self._adjust_further()
            adjusted |= bool(self._shutter.look())
        began_ns, began_cpu = time.monotonic_ns(), time.process_time()
        update = self._mapper.optimise(keyframe.id, self._units.log_scale)
        if update is not None:
            self._tell_solved(False, self._mapper.window, began_ns, time.process_time() - began_cpu)
        closed = self._look(keyframe.id) if self._close_loops else None
        if closed is not None or adjusted:
            update = self._mapper.whole(keyframe.id, loops.take_changes(), update, closed)
            self._keeper.overhauled()
        if update is not None:
            self._bus.publish("map_update", update)
            self._keeper.note_solved(update, self._home_scale)
            self._bus.pulse.values["solve_ms"] = f"{update.solve_ms:.0f}"
        self._show()
        self._bus.pulse.idle()
        return update

    def _look(self, keyframe: int) -> Accepted | None:
        """For a return to an earlier place; parts that it joins have one unit at once."""
        closed = self._mapper.loops.look(keyframe, self._units.between)
        if closed is not None and closed.units is not None:
            query, candidate = (self._mapper.world.keyframes[k] for k in (closed.query, closed.candidate))
            if query.part is not None and candidate.part is not None:
                self._units.join(query.part, candidate.part, closed.units[0])
        return closed

    def _look_again(self, keyframe: int) -> None:
        """By a descriptor that was not there yet when the keyframe was looked at."""
        self._bus.pulse.working(f"place of keyframe {keyframe}", _SOLVE_S)
        self._late = None
        if (closed := self._look(keyframe)) is not None:
            self._settled = False
            self._tell_whole(closed)
        self._rest()

    def _adjust(self) -> None:
        """One step of the global adjustment, so that keyframes are heard in between."""
        self._bus.pulse.working("global adjustment", _ADJUST_S)
        if self._adjust_further():
            self._tell_whole()
        self._rest()

    def _tell_whole(self, closed: Accepted | None = None) -> None:
        """All of the map, between keyframes."""
        changes = self._mapper.loops.take_changes()
        update = self._mapper.whole(max(self._mapper.world.keyframes), changes, closed=closed)
        self._bus.publish("map_update", update)
        self._keeper.overhauled()
        self._show()

    def _adjust_further(self) -> bool:
        """One step of the global adjustment; whether its result is in the map."""
        loops = self._mapper.loops
        if not loops.under_way:
            self._adjusting_since_ns = time.monotonic_ns()
        if (adjusted := loops.adjust(float(np.exp(-self._units.log_scale)))) is not None:
            self._tell_solved(True, len(adjusted.poses), self._adjusting_since_ns, adjusted.cpu_s)
        return adjusted is not None

    def _tell_solved(self, everything: bool, keyframes: int, began_ns: int, cpu_s: float) -> None:
        self._bus.publish("solved", Solved(everything, keyframes, began_ns, time.monotonic_ns(), cpu_s))

    # -- lockstep -----------------------------------------------------------------------------------

    def _lockstep(self) -> bool:
        """Do the next frame's work and acknowledge it; whether there was one."""
        assert self._ticks is not None
        if (tick := self._ticks.take(_LOOK_S)) is None:
            self._hear_of_new_maps()
            self._tidy()
            return False
        if tick.keyframe >= 0:
            self._one(tick)
        self._bus.publish("acknowledged", Acknowledged("backend", tick.index))
        return True

    def _one(self, tick: Tracked) -> None:
        """Wait for the keyframe, its depth and its scale; the tracker waits for an update of each."""
        self._bus.pulse.working(f"waiting for keyframe {tick.keyframe}", _PATIENCE_S + 5.0)
        deadline = time.monotonic() + _PATIENCE_S
        while not self._arrivals.complete(tick.keyframe) and not self._bus.stopped.is_set():
            if time.monotonic() > deadline:
                log.warning("keyframe %d is incomplete: going on with what there is", tick.keyframe)
                break
            self._receive(0.01)
        while (keyframe := self._arrivals.until(tick.keyframe)) is not None:
            self._absorb(keyframe)
            if self._solve(keyframe) is None:
                self._bus.publish("map_update", self._mapper.nothing(keyframe))
        self._rest()

    # -- commands -----------------------------------------------------------------------------------

    def _save_map(self, argument: str) -> Reply:
        try:
            return Reply(True, self._keeper.save(argument, self._home_scale))
        finally:
            self._rest()

    def _load_map(self, argument: str) -> Reply:
        try:
            heard = self._bus.ask("epoch", _ASK_S)  # None: it is down, and takes over what there is then
            self._home_scale, said = self._keeper.load(argument, 0 if heard is None else heard.epoch)
        finally:
            self._rest()
        self._arrivals.give_up()
        self._unsolved = self._late = None
        self._show()
        self._loaded.tell(self._home_scale)
        return Reply(True, f"{said}; looking for the camera in it")

    def _known_unit(self) -> MapLoaded | None:
        """Asked for in another thread: in lockstep ours may be waiting for who asks."""
        loaded = self._loaded.news(self._home_scale)  # amid a load that of before; then one is published, too
        return loaded if loaded.metric else None

    # -- the map for others -------------------------------------------------------------------------

    def _whole_map(self) -> WholeMap | None:
        """All of the map, with the last that was said of it: its tracker may have died during a long solve.

        What came after that would tell of points as the next one, who goes on from here, never had them.
        """
        if self._ticks is None:
            self._receive(0.0)
            while (newest := self._arrivals.next(patient=False)) is not None:
                self._absorb(newest)
                self._unsolved = newest
        return self._keeper.whole(self._home_scale)

    def _show(self) -> None:
        """What the map has come to: on `health`, and for whoever asks for it."""
        show_map(self._bus.pulse.values, self._mapper.world, len(self._arrivals))
        self._snapshot = snapshot(self._mapper, self._settled, self._home_scale.log_scale)


def main(config: Config, bus: Bus) -> None:
    """Runs until ``bus.stopped``."""
    BackendWorker(config, bus).run()
