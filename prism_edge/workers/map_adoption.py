"""The tracker goes on in the backend's map: its own after a restart, a stored one, one of a run cut off."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable

from prism_edge.backend import map_file
from prism_edge.backend.connectivity import parts_of
from prism_edge.backend.local_copy import local_copy
from prism_edge.backend.map_mount import mount_of
from prism_edge.backend.stored_map import from_arrays
from prism_edge.bus.session import Bus
from prism_edge.config import Config
from prism_edge.errors import MapError
from prism_edge.geometry.mount import base_from_camera
from prism_edge.geometry.poses import Array
from prism_edge.messages import WholeMap
from prism_edge.tracking.submaps import Parts
from prism_edge.tracking.tracker import Tracker
from prism_edge.workers.handover import PATIENCE_S
from prism_edge.workers.map_flaw import map_flaw

log = logging.getLogger("prism_edge.tracker")

LINKED_S = 3.0  # a tracker that was started again is wanted soon: without a backend it begins a new map,
# but where one is started again beside it: that reads its journal first, and has the map.
# One that has no map says so at once, as does the end of one that dies: silence is a backend at work.
BUSY_S = PATIENCE_S + 5.0
LOADED_S = 30.0
RECOVERED_S = 30.0  # the backend starts beside us, and reads its journal first
TAKING_OVER_S = 30.0
# A map is asked for again: who was to answer may have just ended.
TRIES, AGAIN_S = 3, 0.3


class MapAdoption:
    """Asks for the whole map and hands it to the tracker."""

    def __init__(self, config: Config, bus: Bus) -> None:
        self._config, self._bus = config, bus
        self._loaded = bus.queue("map_loaded", 8)
        self.travelled = 0.0  # path length of the map that was taken over, map units
        self._mount = base_from_camera(config.frames)
        self._taken: tuple[int, Array] | None = None  # epoch and mount of that map

    def mount(self, epoch: int) -> Array:
        """base_from_camera (4, 4) of who began the map of an epoch: `map` is that times the map's world."""
        return self._taken[1] if self._taken is not None and self._taken[0] == epoch else self._mount

    def of_the_last_life(self) -> WholeMap | None:
        """The backend's map after a restart of the tracker; None where there is none to go on in."""
        comes_back = self._bus.run_directory is not None and "backend" not in self._config.network.remote
        linked_s = RECOVERED_S if comes_back else LINKED_S
        self._bus.pulse.working("asking for the map", 2 * (linked_s + BUSY_S) + TAKING_OVER_S)
        whole = self._of_the_backend(linked_s, BUSY_S)
        if whole is None:
            log.info("no map to go on in: beginning a new one")
        return whole

    def of_a_run_cut_off(self) -> WholeMap | None:
        """The map that the backend has recovered of an earlier run; None where there is none to go on in."""
        self._bus.pulse.working("asking for the map that was left", 4 * RECOVERED_S + TAKING_OVER_S)
        return self._of_the_backend(RECOVERED_S, RECOVERED_S)

    def _of_the_backend(self, linked_s: float, answer_s: float) -> WholeMap | None:
        """The backend's map, asked for again where it died over that: started again, it has the map too."""
        silent_s = float("inf")
        while True:
            missing = self._bus.await_ready(["backend"], linked_s)  # else nobody would be asked
            silent_s = min(silent_s, time.monotonic() + answer_s)
            whole: WholeMap | None = self._bus.ask("whole_map", answer_s)
            if whole is not None or missing or time.monotonic() >= silent_s:
                return whole
            # One that has no map is still there; that one has gone shows a moment later.
            if self._bus.stopped.wait(AGAIN_S) or not self._bus.await_ready(["backend"], 0.0):
                return None

    def take_loaded(
        self, tracker: Tracker, adopt: Callable[[WholeMap], bool], reset: Callable[[str], object]
    ) -> None:
        """Have a map that the backend has just loaded adopted, if there is one newer than the tracker's.

        Where it can't be, there is no way back: backend and scale have left the present map. So the tracker
        is ``reset`` into one that is newer than theirs.
        """
        epoch = max((loaded.epoch for loaded in self._loaded.drain()), default=-1)
        if epoch <= tracker.epoch:
            if 0 <= epoch < tracker.epoch:
                log.error("a map that the backend has taken up is passed over: ours is newer (%d)", epoch)
            return
        self._bus.pulse.working("asking for the loaded map", 2 * LOADED_S + RECOVERED_S + TAKING_OVER_S)
        silent_s = time.monotonic() + LOADED_S
        whole: WholeMap | None = self._bus.ask("whole_map", LOADED_S)
        for _ in range(TRIES):
            if whole is not None or time.monotonic() >= silent_s or self._bus.stopped.wait(AGAIN_S):
                break
            self._bus.await_ready(["backend"], RECOVERED_S)  # started again, it has the map in its journal
            whole = self._bus.ask("whole_map", LOADED_S)
        if whole is None or whole.epoch < epoch or not adopt(whole):
            log.error("the loaded map has not come, or can't be gone on in: a new one begins")
            tracker.epoch = epoch
            reset("")
        self._bus.pulse.idle()

    def take_over(self, tracker: Tracker, whole: WholeMap) -> bool:
        """Put the tracker into the map, lost; False where it can't be gone on in."""
        try:
            info, arrays = map_file.unpack(whole.data.tobytes())
            world, index = from_arrays(info, arrays, self._config.backend.max_carried)
            if flaw := map_flaw(arrays, self._config.tracking):
                raise MapError(flaw)
            mount = mount_of(info)
        except MapError as error:
            log.error("the backend's map can't be gone on in: %s", error)
            return False
        self.travelled = max(k.travelled for k in world.keyframes.values())
        parts = Parts.given(parts_of(world))
        tracker.adopt(local_copy(world), index, parts, whole.epoch, whole.log_scale)
        self._taken = whole.epoch, self._mount if mount is None else mount
        log.info("looking for the camera among %d keyframes", len(world.keyframes))
        return True
