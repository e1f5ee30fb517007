"""The map of a run that was cut off, in the next: what backend and tracker make of it."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from prism_edge.backend import map_file
from prism_edge.backend.journal import Journal
from prism_edge.backend.map_file import Info
from prism_edge.backend.map_scale import KnownScale
from prism_edge.backend.stored_map import from_arrays, to_arrays
from prism_edge.bus import codec
from prism_edge.config import Config, DepthConfig, StateConfig, TrackingConfig
from prism_edge.config_file import dump
from prism_edge.messages import HOME, IDS_A_LIFE, INITIALISING, Epoch, MapLoaded, WholeMap
from prism_edge.workers import backend as worker
from prism_edge.workers.cut_off import TOLD
from tests.synthetic import messages
from tests.workers.backend_bench import CONFIG, hear, keyframes, snapshot
from tests.workers.list_bus import ListBus
from tests.workers.test_map_adoption import AFTER, DRIFT, EPOCH, LOG_SCALE, Asked, errors, whole
from tests.workers.tracker_bench import World, frame, positions, run

__all__ = ["whole"]  # a fixture


class Runs:
    """Runs of one robot that share a state directory."""

    def __init__(self, folder: Path, config: Config = CONFIG) -> None:
        self.folder, self.count = folder, 0
        state = StateConfig(directory=str(folder / "state"))
        tracking = TrackingConfig(levels=8, scale_factor=1.2)
        self.config = replace(config, state=state, tracking=tracking)

    def backend(
        self, told: list, teller, goes_on: bool = False, life: int = 0, again: bool = False, **changes: object
    ) -> ListBus:
        """A backend that hears keyframes; of a new run unless ``again``, which was told to go on or not."""
        self.count += not again
        directory = self.folder / f"run-{self.count}"
        directory.mkdir(exist_ok=True)
        if goes_on:
            (directory / TOLD).touch()
        bus = ListBus("keyframe")
        bus.life, bus.first_id, bus.run_directory = life, life * IDS_A_LIFE, directory
        made = worker.BackendWorker(replace(self.config, **changes), bus)  # type: ignore[arg-type]
        hear(made, bus, told, teller)
        made.run()
        made._show()
        return bus

    def rewrite(self, **info: object) -> None:
        """The journal's base with other plain values, and a checksum that is right."""
        path = self.folder / "state" / "journal" / "base"
        known: Info
        known, arrays = map_file.unpack(path.read_bytes())
        path.write_bytes(map_file.pack({**known, **info}, arrays))


def test_the_next_run_has_the_map_and_says_so(tmp_path: Path) -> None:
    runs = Runs(tmp_path)
    teller, told = keyframes(6, epoch=3 * IDS_A_LIFE)
    before = snapshot(runs.backend(told[:5], teller))
    bus = runs.backend([], teller, goes_on=True)
    after = snapshot(bus)
    assert after.keyframes.tolist() == before.keyframes.tolist() == [0, 1, 2, 3, 4]
    assert set(after.points.tolist()) == set(before.points.tolist())
    np.testing.assert_allclose(after.poses, before.poses, atol=0.03)
    assert "5 keyframes" in bus.pulse.values["recovered"]
    # its epoch is this run's first, whatever the other one's was; the scale filter is told of its unit
    assert after.epoch == 0
    (loaded,) = bus.of("map_loaded")
    assert (loaded.epoch, loaded.log_scale) == (0, pytest.approx(0.25))
    # it goes on, and the next life of this run goes on from there
    runs.backend([replace(told[5], epoch=0)], teller, goes_on=True, again=True)
    assert snapshot(runs.backend([], teller, life=1, again=True)).keyframes.tolist() == [0, 1, 2, 3, 4, 5]


def test_the_next_run_s_camera_is_not_in_the_part_where_that_run_s_was_last(tmp_path: Path) -> None:
    """Depth that its first keyframes bring is taken in the unit of the map's first part."""
    runs = Runs(tmp_path)
    teller, told = keyframes(5)
    for count in range(2):
        bus = ListBus("keyframe")
        bus.run_directory = tmp_path / f"run-{count}"
        bus.run_directory.mkdir()
        if not count:
            made = worker.BackendWorker(runs.config, bus)
            hear(made, bus, told, teller)
            made._units.hear(messages.scale_of(told[-1], 0.7, 0.05, part=77))
            made._keeper.overhauled()
            bus.stopped.set()
            made.run()
            assert made._units.log_scale == pytest.approx(0.7)
    (bus.run_directory / TOLD).touch()
    again = worker.BackendWorker(runs.config, bus)
    assert len(again._mapper.world.keyframes) == 5
    assert again._units.between(77, HOME) is not None, "its parts' metres are known"
    assert again._units.log_scale == pytest.approx(0.25)


@pytest.mark.parametrize("known", [True, False])
def test_what_is_known_of_its_unit_outlives_a_scale_that_knows_nothing(tmp_path: Path, known: bool) -> None:
    runs = Runs(tmp_path)
    teller, told = keyframes(5)
    (tmp_path / "run-0").mkdir()
    for life, new, scale in ((0, told[:3], (0.25, known)), (1, told[3:], (0.0, False))):
        bus = ListBus("keyframe")
        bus.life, bus.first_id, bus.run_directory = life, life * IDS_A_LIFE, tmp_path / "run-0"
        hear(worker.BackendWorker(runs.config, bus), bus, new, teller, *scale)
    after = runs.backend([], teller, goes_on=True)
    assert len(snapshot(after).keyframes) == 5
    (loaded,) = after.of("map_loaded")
    assert (loaded.log_scale, loaded.metric) == (0.25 if known else 0.0, known)


def test_it_is_recovered_once_more_where_that_run_was_cut_off_too(tmp_path: Path) -> None:
    runs = Runs(tmp_path)
    teller, told = keyframes(5, epoch=7)
    runs.backend(told, teller)
    for _ in range(2):  # before anything was added to it
        assert len(snapshot(runs.backend([], teller, goes_on=True)).keyframes) == 5
    # and by a backend that died in its first life before it had read it
    runs.backend([], teller, goes_on=True)
    assert snapshot(runs.backend([], teller, life=1, again=True)).epoch == 0


def test_a_run_that_is_not_told_so_begins_its_own(tmp_path: Path) -> None:
    runs = Runs(tmp_path)
    teller, told = keyframes(4)
    runs.backend(told, teller)
    assert len(snapshot(runs.backend([], teller, life=1)).keyframes) == 0, "another run's, by a later life"
    runs.backend(told, teller)
    bus = runs.backend([], teller)
    assert len(snapshot(bus).keyframes) == 0
    assert bus.of("map_loaded") == []
    assert len(snapshot(runs.backend([], teller, goes_on=True)).keyframes) == 0, "it is gone"


@pytest.mark.parametrize(
    "changes",
    [
        {"robot": "other"},
        {"depth": DepthConfig(model="another")},
        {"tracking": TrackingConfig(levels=8, scale_factor=1.5)},
        {"tracking": TrackingConfig(levels=4, scale_factor=1.2)},
    ],
)
def test_a_foreign_map_is_left(tmp_path: Path, changes: dict[str, object], caplog) -> None:
    runs = Runs(tmp_path)
    teller, told = keyframes(4)
    runs.backend(told, teller)
    bus = runs.backend([], teller, goes_on=True, **changes)
    assert len(snapshot(bus).keyframes) == 0
    assert bus.of("map_loaded") == []
    assert "recovered" not in bus.pulse.values
    assert "the map that was left is not gone on in" in caplog.text


@pytest.mark.parametrize("file", ["base", "tail"])
@pytest.mark.parametrize("damage", ["noise", "cut", "gone", "other values"])
def test_a_damaged_journal_ends_in_a_smaller_map_or_none(tmp_path: Path, file: str, damage: str) -> None:
    runs = Runs(tmp_path)
    teller, told = keyframes(5)
    runs.backend(told, teller)
    path = tmp_path / "state" / "journal" / file
    data = path.read_bytes()
    if damage == "gone":
        path.unlink()
    elif damage == "other values":
        runs.rewrite(log_scale="x", epoch=-1, run=5)
    else:
        path.write_bytes(data[: len(data) // 2] if damage == "cut" else b"noise" + data[5:])
    bus = runs.backend([], teller, goes_on=True)
    known = snapshot(bus).keyframes.tolist()
    assert known == list(range(len(known)))
    assert bool(known) == (file == "tail" and damage != "other values")
    assert bool(bus.of("map_loaded")) == bool(known)
    # and a map can be begun: what comes next is taken in and kept
    fresh = [replace(k, epoch=1) for k in told]
    runs.backend(fresh, teller, goes_on=True)
    assert snapshot(runs.backend([], teller, life=1, again=True)).keyframes.tolist() == [0, 1, 2, 3, 4]


def test_keyframes_of_another_build_cost_themselves_and_what_follows(tmp_path: Path, caplog) -> None:
    """Their messages may have other fields; the map that they were added to is sound."""
    runs = Runs(tmp_path)
    teller, told = keyframes(3)
    runs.backend(told, teller)
    journal = Journal(tmp_path / "state" / "journal")
    found = journal.recover()
    assert found is not None
    info, arrays, records = found
    foreign = map_file.pack(KnownScale().info, {"keyframe": np.frombuffer(codec.pack(Epoch(0)), np.uint8)})
    journal.begin(lambda generation: map_file.pack({**info, "generation": generation}, arrays))
    last = max(i for i, record in enumerate(records) if "keyframe" in map_file.unpack(record)[1])
    for record in (*records[:last], foreign, *records[last:]):
        journal.append(record)
    journal.close()
    assert snapshot(runs.backend([], teller, goes_on=True)).keyframes.tolist() == [0, 1]
    assert "another build" in caplog.text


class Next(Asked):
    """A tracker of a run that was told to go on."""

    def __init__(self, answer: WholeMap | None, folder: Path, life: int = 0) -> None:
        super().__init__(answer, life)
        self.bus.run_directory = folder
        (folder / TOLD).touch()


def words(bus: ListBus) -> list[str]:
    return [message.status[0].message for message in bus.of("status")]


def test_the_tracker_goes_on_in_its_coordinates(whole: WholeMap, tmp_path: Path) -> None:
    found = replace(whole, epoch=0)  # as the backend has it in the first life
    life = Next(found, tmp_path)
    life.bus.give("map_loaded", MapLoaded(0, LOG_SCALE, 0.05))  # for the scale filter: known here already
    run(life.bus, [frame(i) for i in AFTER])
    assert life.asked == ["whole_map"]
    assert min(positions(life.bus)) <= AFTER[0] + 5
    assert len(positions(life.bus)) >= len(AFTER) - 5
    assert np.median(errors(life.bus)) < DRIFT
    assert {k.epoch for k in life.bus.of("keyframe")} == {0}
    assert "ok recovered" in words(life.bus)
    assert words(life.bus)[-1] == "ok recovered"  # for two seconds


def test_the_lens_that_was_found_is_kept(whole: WholeMap, tmp_path: Path) -> None:
    info, arrays = map_file.unpack(whole.data.tobytes())
    world, index = from_arrays(info, arrays, 100)
    assert world.camera is not None
    lens = world.camera.bent(-0.005)
    world.take_lens(lens)
    cameras, moved = to_arrays(world, index)
    data = np.frombuffer(map_file.pack({**info, **cameras}, moved), np.uint8)
    life = Next(replace(whole, epoch=0, data=data), tmp_path)
    life.bus.give("map_loaded", MapLoaded(0, LOG_SCALE, 0.05))
    run(life.bus, [frame(i) for i in AFTER])
    assert "ok recovered" in words(life.bus)
    made = life.bus.of("keyframe")
    assert made
    assert all(keyframe.camera.tolist() == lens.to_array().tolist() for keyframe in made)


def test_another_camera_begins_a_map_of_its_own(whole: WholeMap, tmp_path: Path, caplog) -> None:
    life = Next(replace(whole, epoch=0), tmp_path)
    life.bus.give("map_loaded", MapLoaded(0, LOG_SCALE, 0.05))
    other = frame(AFTER[0]).camera.copy()
    other[2] *= 1.01  # focal length
    run(life.bus, [frame(i, camera=other) for i in AFTER])
    assert "made by another camera" in caplog.text
    assert positions(life.bus)
    assert {k.epoch for k in life.bus.of("keyframe")} == {1}, "newer than what the backend holds"
    assert not any("recovered" in word for word in words(life.bus))
    assert INITIALISING in words(life.bus)[1]


def test_a_reset_may_come_before_the_first_image_has_proved_the_map(whole: WholeMap, tmp_path: Path) -> None:
    life = Next(replace(whole, epoch=0), tmp_path)
    life.bus.desk.ask("reset")
    run(life.bus, [frame(i) for i in AFTER])
    assert {k.epoch for k in life.bus.of("keyframe")} == {1}
    assert positions(life.bus)
    assert not any("recovered" in word for word in words(life.bus))


@pytest.mark.parametrize("data", [None, b"", b"noise" * 100])
def test_without_a_map_to_go_on_in_a_new_one_begins(data: bytes | None, tmp_path: Path) -> None:
    answer = None if data is None else WholeMap(0, 1, 0.0, 0.1, np.frombuffer(data, np.uint8))
    life = Next(answer, tmp_path)
    run(life.bus, [frame(i) for i in AFTER])
    assert positions(life.bus)
    # A map that the backend may have read too late to answer can't be taken for it.
    assert {k.epoch for k in life.bus.of("keyframe")} == {1}


def test_a_later_life_asks_as_ever(whole: WholeMap, tmp_path: Path) -> None:
    life = Next(whole, tmp_path, life=1)
    run(life.bus, [frame(i) for i in AFTER])
    assert {k.epoch for k in life.bus.of("keyframe")} == {EPOCH}
    assert not any("recovered" in word for word in words(life.bus))


def test_in_lockstep_nobody_asks(whole: WholeMap, tmp_path: Path) -> None:
    life = Next(whole, tmp_path)
    World(life.bus)
    run(life.bus, [frame(0)], replace(CONFIG, mode="lockstep"))
    assert life.asked == []


def test_a_map_that_is_loaded_before_the_first_image_is_no_earlier_run_s(
    whole: WholeMap, tmp_path: Path, caplog
) -> None:
    """Whichever camera made it, the operator has asked for it."""
    life = Next(replace(whole, epoch=0), tmp_path)
    life.answers = [replace(whole, epoch=0), replace(whole, epoch=1001)]
    life.bus.give("map_loaded", MapLoaded(1001, LOG_SCALE, 0.05))
    other = frame(AFTER[0]).camera.copy()
    other[2] *= 1.01
    run(life.bus, [frame(i, camera=other) for i in AFTER])
    assert "made by another camera" not in caplog.text
    assert {k.epoch for k in life.bus.of("keyframe")} <= {1001}
    assert positions(life.bus)
    assert not any("recovered" in word for word in words(life.bus))


def test_a_network_that_was_reloaded_is_the_one_that_the_next_run_must_have(tmp_path: Path) -> None:
    """Only `depth` and `scale` start anew with it; the backend is told by the run's file alone."""
    runs = Runs(tmp_path, replace(CONFIG, depth=DepthConfig(model="first.onnx")))
    teller, told = keyframes(5)
    bus = ListBus("keyframe")
    bus.run_directory = tmp_path / "run-0"
    bus.run_directory.mkdir()
    file = bus.run_directory / "config.yaml"
    file.write_text(dump(runs.config))
    made = worker.BackendWorker(runs.config, bus)  # type: ignore[arg-type]
    hear(made, bus, told[:4], teller)
    file.write_text(dump(replace(runs.config, depth=DepthConfig(model="second.onnx"))))
    os.utime(file, ns=(1, 1))  # whatever the clock's grain
    hear(made, bus, told[4:], teller)
    made.run()
    old = runs.backend([], teller, goes_on=True)
    assert len(snapshot(old).keyframes) == 0
    made = worker.BackendWorker(runs.config, bus)  # type: ignore[arg-type]
    hear(made, bus, told, teller)
    made.run()
    new = runs.backend([], teller, goes_on=True, depth=DepthConfig(model="second.onnx"))
    assert len(snapshot(new).keyframes) == 5
