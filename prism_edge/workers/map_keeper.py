"""The backend's map outside its process: the journal that a restart recovers, and maps saved by name."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from prism_edge import __version__
from prism_edge.backend import map_file
from prism_edge.backend.connectivity import parts_of
from prism_edge.backend.journal import Journal
from prism_edge.backend.map_file import Arrays, Info
from prism_edge.backend.map_mount import difference, mount_of
from prism_edge.backend.map_scale import KnownScale
from prism_edge.backend.mapper import Mapper
from prism_edge.backend.part_units import PartUnits
from prism_edge.backend.solved_record import solution_of, solved_arrays
from prism_edge.bus import codec
from prism_edge.bus.session import Bus
from prism_edge.config import Config
from prism_edge.errors import BusError, MapError
from prism_edge.geometry.mount import base_from_camera
from prism_edge.messages import Keyframe, MapUpdate, WholeMap, same_network
from prism_edge.workers.configured_network import ConfiguredNetwork
from prism_edge.workers.cut_off import OWN_JOURNAL, goes_on
from prism_edge.workers.map_flaw import map_flaw, pyramid_flaw, size_flaw
from prism_edge.workers.state_directory import kept_journal, map_path, stored_map

log = logging.getLogger("prism_edge.backend")

EPOCHS_BETWEEN = 1000  # room for maps that the tracker may begin before it hears of a loaded one
AGAIN_S, SELDOM_S = 2.0, 60.0  # a journal that could not be written is tried again after: at first, at most


class MapKeeper:
    """Keeps the journal of a mapper, and saves its map."""

    def __init__(self, config: Config, bus: Bus, mapper: Mapper, units: PartUnits) -> None:
        """``units`` are of the mapper's parts: they are kept, and taken up, with its map."""
        self._config, self._bus, self._mapper, self._units = config, bus, mapper, units
        self._mount = base_from_camera(config.frames)
        self._journal: Journal | None = None
        self._failed_s, self._wait_s = float("-inf"), AGAIN_S
        self._overhauled = False
        self._network, self._noted_network = ConfiguredNetwork(config, bus), ""
        self.heard_network = ""  # as it calls itself in this run's depths; a loaded map's may be another
        self._run = "" if bus.run_directory is None else bus.run_directory.name
        folder = journal_folder(config, bus)
        if bus.run_directory is None and config.state.journal:
            log.warning("started by hand it keeps no journal: at its end a map that was not saved is lost")
        if folder is not None:
            try:
                self._journal = Journal(folder)
            except MapError as error:
                self._say(error)

    def recover(self) -> KnownScale | None:
        """Take the map up where the last life left it, or a run that was cut off; its scale, None for no map.

        In the first life of any other run, forget what an earlier run left: its tracker's numbers mean
        nothing in this one.
        """
        if self._journal is None:
            return None
        going_on = goes_on(self._bus)
        if not self._bus.life and not going_on:
            self._journal.clear()
            return None
        found = self._journal.recover()
        if found is None:
            log.warning("no map to recover: beginning an empty one")
            return None
        info, arrays, records = found
        # Another run's epochs may be ahead of this one's: here its map is the first.
        foreign = info.get("run") != self._run
        problem = self._foreign_flaw(info, arrays) if foreign and going_on else "it is of another run"
        if foreign and (problem or not going_on):
            log.warning("the map that was left is not gone on in: %s", problem)
            self._journal.clear()
            return None
        try:
            scale = self._mapper.restore(info, arrays, 0 if foreign else None, self._mount)
            self._units.begin(scale)
            self._units.take(info)
            scale = self._replayed(records, scale)
        except (MapError, KeyError, ValueError) as error:
            log.warning("the map could not be recovered: %s", error)
            self._mapper.begin(0)
            self._units.begin(KnownScale())
            return None
        world = self._mapper.world
        log.info("recovered %d keyframes and %d points", len(world.keyframes), len(world.points))
        if foreign:
            if odd := difference(mount_of(info), self._mount):
                log.warning("the map that was left was %s", odd)
            self._units.go_home()  # where that run's camera was last, this one's is not
            self._bus.pulse.values["recovered"] = f"{len(world.keyframes)} keyframes of an earlier run"
        return scale

    def _replayed(self, records: list[bytes], scale: KnownScale) -> KnownScale:
        """What has become of the base, up to the first record that can't be read; the map's scale by then.

        Nothing of a record is in the map before it has been read.
        """
        for record in records:
            try:
                scale = self._absorb(record)
            except BusError as error:
                log.warning("keyframes since then are left out, they are of another build: %s", error)
                return scale
            except MapError as error:
                log.warning("what came since then is left out, it can't be read: %s", error)
                return scale
        return scale

    def _foreign_flaw(self, info: Info, arrays: Arrays) -> str:
        """Why another run's map can't be gone on in; empty where it can, by the camera that made it."""
        for what, ours in (("robot", self._config.robot), ("model", self._network.name)):
            if info.get(what) != ours:
                return f"it has another {what}, {info.get(what)!r:.60}"
        return pyramid_flaw(arrays, self._config.tracking)

    def note(self, message: Keyframe, scale: KnownScale) -> None:
        """A keyframe has been absorbed, with its depth and its place."""
        if self._journal is None:
            return
        if len(self._mapper.world.keyframes) == 1:  # of a new map
            self.overhauled()
        if self._is_failing:
            return
        try:
            is_news = self._overhauled or self._noted_network != self._network.name
            if is_news or self._journal.is_long or not self._journal.is_open:
                self._begin_journal(self._journal, scale)
            else:
                self._journal.append(self._record(message.id, scale, codec.pack(message)))
        except MapError as error:
            self._say(error)

    def note_late(self, number: int, scale: KnownScale) -> None:
        """Depth, place or weights have come of a keyframe that was noted without them.

        Where no record can be added now, the next base will have them.
        """
        self._append(lambda: self._record(number, scale))

    def note_solved(self, update: MapUpdate, scale: KnownScale) -> None:
        """A window's result is in the map, and told; the next base would have it."""
        self._append(lambda: map_file.pack(scale.info, solved_arrays(update)))

    def _append(self, record: Callable[[], bytes]) -> None:
        """One record more, where the journal is open and a record would go on from what it holds."""
        journal = self._journal
        if journal is None or not journal.is_open or self._overhauled:
            return
        try:
            journal.append(record())
        except MapError as error:
            self._say(error)

    def overhauled(self) -> None:
        """All of the map has moved, or is another: what the journal holds would contradict the tracker's.

        Where it can't be written anew, no map is better than that one.
        """
        self._overhauled = True
        if self._journal is not None and self._is_failing:
            self._journal.clear()

    def forget(self) -> None:
        """The map was given up; the journal begins anew with the first keyframe of the next."""
        self._overhauled = False
        self._units.begin(KnownScale())
        if self._journal is not None:
            self._journal.clear()

    def tidy(self, scale: KnownScale) -> bool:
        """Write a map that has moved as a whole, once; for a moment without other work. Whether it was tried.

        A life that ended before would be gone on from with the map of before, and move the tracker's back.
        """
        if self._journal is None or not self._overhauled or self._is_failing:
            return False
        try:
            self._begin_journal(self._journal, scale)
        except MapError as error:
            self._say(error)
        return True

    def load(self, name: str, tracked: int = 0) -> tuple[KnownScale, str]:
        """Take a saved map up in place of the present one, as a new epoch; its scale, and what was loaded.

        ``tracked`` is the tracker's epoch, which may be later than any that it has told keyframes of. Raises
        MapError, with the present one kept, where there is none, or none that could be gone on with.
        """
        path = stored_map(self._config.state, name)
        self._bus.pulse.working("loading a map", 60.0)
        info, arrays = map_file.unpack(map_file.read(path))
        if flaw := map_flaw(arrays, self._config.tracking):
            raise MapError(flaw)
        foreign = self._places_are_foreign(info)
        ours = self._mapper.world.camera
        epoch = max(self._mapper.epoch, tracked) + EPOCHS_BETWEEN
        scale = self._mapper.restore(info, arrays, epoch, self._mount)
        self._units.begin(scale)
        if foreign:
            self._mapper.loops.index.clear()
        self.overhauled()
        try:
            if self._journal is not None:
                self._begin_journal(self._journal, scale)
        except MapError as error:
            self._say(error)
        world = self._mapper.world
        said = f"loaded {name}: {len(world.keyframes)} keyframes, {len(world.points)} points"
        said += ", without another depth network's words for its places" if foreign else ""
        theirs = world.camera
        if ours is not None and theirs is not None and not theirs.like(ours):
            said += ", of another camera"
        if odd := difference(mount_of(info), self._mount):
            said += f", {odd}"
        return scale, said

    def _places_are_foreign(self, info: Info) -> bool:
        """Whether another network than ours has described a stored map's places, as far as is known here."""
        theirs, ours = info.get("places_of"), self.heard_network
        # As it calls itself; where ours is yet to speak, PlaceIndex will see.
        if isinstance(theirs, str) and theirs:
            return bool(ours) and not same_network(theirs, ours)
        return info.get("model") != self._network.name

    def whole(self, scale: KnownScale) -> WholeMap | None:
        """Everything, for a tracker to go on from; None where there is nothing."""
        mapper = self._mapper
        if not mapper.world.points:
            return None
        data = np.frombuffer(self._packed(scale, True), np.uint8)
        return WholeMap(mapper.epoch, mapper.sequence, scale.log_scale, scale.whole_sigma, data)

    def _begin_journal(self, journal: Journal, scale: KnownScale) -> None:
        self._bus.pulse.working("writing the journal", 30.0)
        self._noted_network = self._network.name
        journal.begin(lambda generation: self._packed(scale, True, generation=generation, run=self._run))
        self._bus.pulse.values.pop("journal", None)
        self._overhauled, self._failed_s, self._wait_s = False, float("-inf"), AGAIN_S

    def save(self, name: str, scale: KnownScale) -> str:
        """Save the map under a name; says what was saved. Raises MapError."""
        path = map_path(self._config.state, name)
        world = self._mapper.world
        if not world.keyframes:
            raise MapError("there is no map to save yet")
        if flaw := size_flaw(len(world.keyframes), bool(world.points)):
            raise MapError(flaw)  # as loading it would
        self._bus.pulse.working("saving the map", 60.0)
        data = self._packed(scale, False, saved=datetime.now(UTC).isoformat(timespec="seconds"))
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise MapError(f"can't make {path.parent}: {error.strerror or error}") from None
        earlier = ", in place of an earlier map of that name" if os.path.exists(path) else ""
        map_file.write(path, data)
        apart = len(parts_of(world))
        unplaced = f" ({apart} of them apart, without a place in map)" if apart else ""
        counts = f"{len(world.keyframes)} keyframes{unplaced}, {len(world.points)} points"
        return f"saved {name}: {counts}, {len(data) / 1e6:.1f} MB{earlier}"

    def _packed(self, scale: KnownScale, in_use: bool, **info: str | int) -> bytes:
        own = {"program": f"prism_edge {__version__}", "robot": self._config.robot}
        stored, arrays = self._mapper.stored(in_use)
        known = {**stored, **own, **scale.info, "model": self._network.name, **info}
        known |= self._known_units if in_use else {}
        return map_file.pack(known, arrays)

    def _record(self, number: int, scale: KnownScale, message: bytes = b"") -> bytes:
        """A keyframe as its message has it and what belongs to it; without the message, what came late."""
        keyframe = self._mapper.world.keyframes[number]
        depths, weights = keyframe.depths, keyframe.weights
        place = self._mapper.loops.index.get(number)
        arrays: Arrays = {
            "keyframe": np.frombuffer(message, np.uint8),
            "depths": np.zeros(0, np.float32) if depths is None else depths.astype(np.float32),
            "weights": np.zeros(0, np.float32) if weights is None else weights.astype(np.float32),
            "place": np.zeros(0, np.float32) if place is None else place,
        }
        told = {
            "places_of": self._mapper.loops.index.network,
            "depth_sigma": keyframe.depth_sigma,
            "depth_units": keyframe.depth_units,
        }
        return map_file.pack({**scale.info, **self._known_units, **told, "number": number}, arrays)

    @property
    def _known_units(self) -> Info:
        return self._units.info(keyframe.part for keyframe in self._mapper.world.keyframes.values())

    def _absorb(self, record: bytes) -> KnownScale:
        """Raises BusError or MapError for a record that can't be read; nothing of it is in the map then."""
        info, arrays = map_file.unpack(record)
        scale = KnownScale.of(info)
        if "solved" in arrays:
            self._mapper.replay(solution_of(arrays))
            return scale
        number = info.get("number")
        try:
            told = arrays["keyframe"]
            message = codec.unpack(told.tobytes(), Keyframe) if told.size else None
            depths, weights, place = (arrays[name] for name in ("depths", "weights", "place"))
        except KeyError as error:
            raise MapError(f"a keyframe's record has no {error}") from None
        if {depths.ndim, weights.ndim, place.ndim} != {1}:
            raise MapError("a keyframe's record is none")
        self._units.take(info)
        if message is not None:
            self._mapper.absorb(replace(message, epoch=self._mapper.epoch))
            number = message.id
        keyframe = self._mapper.world.keyframes.get(number) if isinstance(number, int) else None
        if keyframe is None:  # what came late for one that has gone since
            return scale
        if len(depths) == len(keyframe.pixels):
            keyframe.depths = depths.astype(np.float64)
            sigma, units = info.get("depth_sigma"), info.get("depth_units")  # earlier builds don't say
            keyframe.depth_sigma = sigma if isinstance(sigma, float) else 0.0
            keyframe.depth_units = units if isinstance(units, float) else 0.0
        if len(weights) == len(keyframe.pixels):
            keyframe.weights = weights.astype(np.float64)
        if len(place):
            self._mapper.loops.add_place(keyframe.id, place, str(info.get("places_of", "")))
        return scale

    @property
    def _is_failing(self) -> bool:
        """Whether the journal could not be written so short a time ago that it isn't tried again yet."""
        return time.monotonic() < self._failed_s + self._wait_s

    def _say(self, error: MapError) -> None:
        """The map goes on without a journal, which `health` shows until it can be written again."""
        if self._journal is not None and self._overhauled:
            self._journal.clear()  # as far as it goes: what can't be written may be removed
        if self._failed_s > 0.0:  # again
            self._wait_s = min(2.0 * self._wait_s, SELDOM_S)
        self._failed_s = time.monotonic()
        if "journal" not in self._bus.pulse.values:
            log.warning("no journal for the moment: %s", error)
        self._bus.pulse.values["journal"] = str(error)


def journal_folder(config: Config, bus: Bus) -> Path | None:
    """Where the journal is kept: with the state where a folder was given for it and the run has it, else with
    the run. None for a worker that was started by hand, whose lives nobody counts: it would recover nothing.
    """
    if bus.run_directory is None or not config.state.journal:
        return None
    kept = None if (bus.run_directory / OWN_JOURNAL).is_file() else kept_journal(config.state)
    return kept or bus.run_directory / "journal"
