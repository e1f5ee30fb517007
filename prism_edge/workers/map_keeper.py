"""The backend's map outside its process: the journal that a restart recovers, and maps saved by name."""

from __future__ import annotations

import logging
import os
import time
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from prism_edge import __version__
from prism_edge.backend import map_file
from prism_edge.backend.journal import Journal
from prism_edge.backend.map_file import Arrays
from prism_edge.backend.mapper import Mapper
from prism_edge.bus import codec
from prism_edge.bus.session import Bus
from prism_edge.config import Config
from prism_edge.errors import BusError, MapError
from prism_edge.messages import Keyframe
from prism_edge.workers.state_directory import map_path, state_directory

log = logging.getLogger("prism_edge.backend")

AGAIN_S = 60.0  # after a journal that could not be written (a full disk) it is tried again


class MapKeeper:
    """Keeps the journal of a mapper, and saves its map."""

    def __init__(self, config: Config, bus: Bus, mapper: Mapper) -> None:
        self._config, self._bus, self._mapper = config, bus, mapper
        self._journal: Journal | None = None
        self._failed_s = float("-inf")
        self._overhauled = False
        folder = journal_folder(config, bus)
        if folder is not None:
            try:
                self._journal = Journal(folder)
            except MapError as error:
                self._say(error)

    def recover(self) -> float | None:
        """In a later life: take the map up where the last life left it; its log scale, None for no map.

        In the first, forget what an earlier run left: its tracker's numbers mean nothing in this one.
        """
        if self._journal is None:
            return None
        if not self._bus.life:
            self._journal.clear()
            return None
        found = self._journal.recover()
        if found is None:
            log.warning("no map to recover: beginning an empty one")
            return None
        info, arrays, records = found
        try:
            log_scale = self._mapper.restore(info, arrays)
            for record in records:
                log_scale = self._absorb(record)
        except (MapError, BusError, KeyError, ValueError) as error:
            log.warning("the map could not be recovered: %s", error)
            self._mapper.begin(0)
            return None
        world = self._mapper.world
        log.info("recovered %d keyframes and %d points", len(world.keyframes), len(world.points))
        return log_scale

    def note(self, message: Keyframe, log_scale: float) -> None:
        """A keyframe has been absorbed, with its depth and its place."""
        if self._journal is None or time.monotonic() < self._failed_s + AGAIN_S:
            return
        try:
            first = len(self._mapper.world.keyframes) == 1  # of a new map
            if first or self._overhauled or self._journal.is_long or not self._journal.is_open:
                self._bus.pulse.working("writing the journal", 30.0)
                self._journal.begin(lambda generation: self._packed(log_scale, generation=generation))
                self._bus.pulse.values.pop("journal", None)
                self._overhauled = False
            else:
                self._journal.append(self._record(message, log_scale))
        except MapError as error:
            self._say(error)

    def overhauled(self) -> None:
        """All of the map has moved: what the journal holds would contradict the tracker's."""
        self._overhauled = True

    def save(self, name: str, log_scale: float) -> str:
        """Save the map under a name; says what was saved. Raises MapError."""
        path = map_path(self._config.state, name)
        world = self._mapper.world
        if not world.keyframes:
            raise MapError("there is no map to save yet")
        self._bus.pulse.working("saving the map", 60.0)
        data = self._packed(log_scale, saved=datetime.now(UTC).isoformat(timespec="seconds"))
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise MapError(f"can't make {path.parent}: {error.strerror or error}") from None
        map_file.write(path, data)
        counts = f"{len(world.keyframes)} keyframes, {len(world.points)} points"
        return f"saved {name}: {counts}, {len(data) / 1e6:.1f} MB"

    def _packed(self, log_scale: float, **info: str | int) -> bytes:
        own = {"program": f"prism_edge {__version__}", "robot": self._config.robot, "log_scale": log_scale}
        stored, arrays = self._mapper.stored()
        return map_file.pack({**stored, **own, "model": self._config.depth.model, **info}, arrays)

    def _record(self, message: Keyframe, log_scale: float) -> bytes:
        keyframe = self._mapper.world.keyframes[message.id]
        depths, weights = keyframe.depths, keyframe.weights
        place = self._mapper.loops.index.get(message.id)
        arrays: Arrays = {
            "keyframe": np.frombuffer(codec.pack(message), np.uint8),
            "depths": np.zeros(0, np.float32) if depths is None else depths.astype(np.float32),
            "weights": np.zeros(0, np.float32) if weights is None else weights.astype(np.float32),
            "place": np.zeros(0, np.float32) if place is None else place,
        }
        return map_file.pack({"log_scale": log_scale}, arrays)

    def _absorb(self, record: bytes) -> float:
        info, arrays = map_file.unpack(record)
        message = codec.unpack(arrays["keyframe"].tobytes(), Keyframe)
        self._mapper.absorb(message)
        keyframe = self._mapper.world.keyframes[message.id]
        if len(arrays["depths"]) == len(keyframe.pixels):
            keyframe.depths = arrays["depths"].astype(np.float64)
        if len(arrays["weights"]) == len(keyframe.pixels):
            keyframe.weights = arrays["weights"].astype(np.float64)
        if len(arrays["place"]):
            self._mapper.loops.add_place(message.id, arrays["place"])
        return float(info["log_scale"])

    def _say(self, error: MapError) -> None:
        """The map goes on without a journal, which `health` shows until it can be written again."""
        self._failed_s = time.monotonic()
        if "journal" not in self._bus.pulse.values:
            log.warning("no journal for the moment: %s", error)
        self._bus.pulse.values["journal"] = str(error)


def journal_folder(config: Config, bus: Bus) -> Path | None:
    """Where the journal is kept: with the state where a folder was given for it, else with the run.

    None where neither is, as for a worker that was started by hand.
    """
    if not config.state.journal:
        return None
    if config.state.directory or os.environ.get("STATE_DIRECTORY"):
        return state_directory(config.state) / "journal"
    return None if bus.run_directory is None else bus.run_directory / "journal"
