"""The backend's map beyond its process: recovered after a kill."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from prism_edge.backend import map_file
from prism_edge.backend.map_scale import KnownScale
from prism_edge.backend.mapper import Mapper
from prism_edge.config import BackendConfig, StateConfig
from prism_edge.errors import MapError
from prism_edge.messages import IDS_A_LIFE
from prism_edge.workers import backend as worker
from prism_edge.workers import map_keeper
from prism_edge.workers.cut_off import OWN_JOURNAL
from tests.workers.backend_bench import CONFIG, depth_of, gate_of, hear, keyframes, live, snapshot
from tests.workers.list_bus import ListBus


def test_a_life_that_ended_by_force_is_gone_on_from(tmp_path: Path) -> None:
    teller, told = keyframes(6)
    before = snapshot(live(tmp_path, told[:5], teller))
    bus = live(tmp_path, [], teller, life=1)
    recovered = snapshot(bus)
    assert recovered.keyframes.tolist() == before.keyframes.tolist()
    assert set(recovered.points.tolist()) == set(before.points.tolist())
    assert recovered.log_scale == pytest.approx(0.25)
    np.testing.assert_allclose(recovered.poses, before.poses, atol=1e-9)  # as the last window left them
    after = live(tmp_path, told[5:], teller, life=2)
    assert snapshot(after).keyframes.tolist() == [0, 1, 2, 3, 4, 5]
    (update,) = after.of("map_update")
    assert update.sequence > IDS_A_LIFE  # newer than what earlier lives said
    assert set(update.keyframes.tolist()) >= {2, 3, 4, 5}


def test_the_first_life_of_a_run_forgets_what_another_left(tmp_path: Path) -> None:
    teller, told = keyframes(4)
    live(tmp_path, told, teller)
    assert len(snapshot(live(tmp_path, [], teller)).keyframes) == 0
    assert len(snapshot(live(tmp_path, [], teller, life=1)).keyframes) == 0


def test_a_new_epoch_begins_the_journal_anew(tmp_path: Path) -> None:
    teller, told = keyframes(6)
    later = [replace(k, epoch=1) for k in told[3:]]
    live(tmp_path, [*told[:3], *later], teller)
    assert snapshot(live(tmp_path, [], teller, life=1)).keyframes.tolist() == [3, 4, 5]


def test_a_map_that_moved_as_a_whole_is_written_as_a_whole(tmp_path: Path) -> None:
    teller, told = keyframes(4)
    bus = ListBus("keyframe")
    bus.run_directory = tmp_path
    made = worker.BackendWorker(CONFIG, bus)
    for keyframe in told[:3]:
        bus.give("depth", depth_of(keyframe, teller))
        bus.give("gate", gate_of(keyframe))
        bus.give("keyframe", keyframe)
        made._realtime()
    made._mapper.world.keyframes[1].world_from_camera[0, 3] += 5.0
    made._keeper.overhauled()
    made._absorb(told[3])
    again = snapshot(live(tmp_path, [], teller, life=1))
    assert again.poses[1][0, 3] == pytest.approx(made._mapper.world.keyframes[1].world_from_camera[0, 3])


@pytest.mark.parametrize("file", ["base", "tail"])
@pytest.mark.parametrize("damage", ["noise", "cut", "gone"])
def test_a_damaged_journal_ends_in_a_smaller_map_or_none(tmp_path: Path, file: str, damage: str) -> None:
    teller, told = keyframes(5)
    live(tmp_path, told, teller)
    path = tmp_path / "journal" / file
    data = path.read_bytes()
    if damage == "gone":
        path.unlink()
    else:
        path.write_bytes(data[: len(data) // 2] if damage == "cut" else b"noise" + data[5:])
    bus = live(tmp_path, [], teller, life=1)
    known = snapshot(bus).keyframes.tolist()
    assert known == list(range(len(known)))
    assert bool(known) == (file == "tail")
    assert bus.states == []  # and it is up: nothing was raised


def test_a_full_disk_costs_the_journal_alone_and_health_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object, **__: object) -> None:
        raise MapError("can't write base: No space left on device")

    monkeypatch.setattr(map_file, "write", full)
    teller, told = keyframes(4)
    bus = live(tmp_path, told, teller, ask=("lab",))
    assert snapshot(bus).keyframes.tolist() == [0, 1, 2, 3]
    assert bus.of("map_update")
    assert "No space left" in bus.pulse.values["journal"]
    (reply,) = bus.desk.replies
    assert (reply.ok, reply.said) == (False, "can't write base: No space left on device")


def test_a_number_that_no_file_can_have_costs_the_journal_alone(tmp_path: Path) -> None:
    teller, told = keyframes(4)
    bus = ListBus("keyframe")
    bus.run_directory = tmp_path
    made = worker.BackendWorker(CONFIG, bus)
    for late, message in enumerate(told):
        if late == 2:
            made._keeper.note_late(1, KnownScale(np.nan))
            assert "JSON" in bus.pulse.values["journal"]
        bus.give("depth", depth_of(message, teller))
        bus.give("gate", gate_of(message))
        bus.give("keyframe", message)
        made._realtime()
    assert list(made._mapper.world.keyframes) == [0, 1, 2, 3]


def test_a_disk_that_is_full_for_a_while_is_tried_again_ever_less_often(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now, tried, write = [100.0], [], map_file.write

    def full(path: Path, data: bytes, durable: bool = True) -> None:
        tried.append(round(now[0] - 100.0))
        if now[0] < 160.0:
            raise MapError("can't write base: No space left on device")
        write(path, data, durable=durable)

    monkeypatch.setattr(map_file, "write", full)
    monkeypatch.setattr(map_keeper, "time", SimpleNamespace(monotonic=lambda: now[0]))
    teller, told = keyframes(4)
    bus = ListBus("keyframe")
    bus.run_directory = tmp_path
    made = worker.BackendWorker(CONFIG, bus)
    for keyframe in told:
        hear(made, bus, [keyframe], teller)
    for _ in range(160):
        made._keeper.note(told[-1], KnownScale())
        now[0] += 1.0
    assert tried[:6] == [0, 2, 6, 14, 30, 62], "as often as it fails, twice as long"
    assert "journal" not in bus.pulse.values
    kept = live(tmp_path, [], teller, life=1)
    assert snapshot(kept).keyframes.tolist() == [0, 1, 2, 3]


def test_no_journal_where_there_is_no_folder_for_it_or_none_is_wanted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("STATE_DIRECTORY", raising=False)
    teller, told = keyframes(2)
    live(tmp_path, told, teller, config=replace(CONFIG, state=StateConfig(journal=False)))
    assert list(tmp_path.iterdir()) == []
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path / "state"))
    live(tmp_path / "run", told, teller)
    assert (tmp_path / "state" / "journal" / "base").is_file()


def test_what_is_kept_with_the_state_is_left_alone_by_a_run_that_does_not_have_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two runs with one state directory; and a worker that was started by hand, which has no run."""
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path / "state"))
    teller, told = keyframes(3)
    live(tmp_path / "first", told, teller)
    kept = {path: path.read_bytes() for path in (tmp_path / "state" / "journal").iterdir()}
    second = tmp_path / "second"
    second.mkdir()
    (second / OWN_JOURNAL).touch()
    live(second, told[:2], teller)
    assert snapshot(live(second, [], teller, life=1)).keyframes.tolist() == [0, 1]
    by_hand = ListBus("keyframe")
    hear(worker.BackendWorker(CONFIG, by_hand), by_hand, told[:1], teller)
    assert {path: path.read_bytes() for path in (tmp_path / "state" / "journal").iterdir()} == kept


def test_the_journal_knows_whose_words_its_places_are_in(tmp_path: Path) -> None:
    teller, told = keyframes(4)
    bus = ListBus("keyframe")
    bus.run_directory = tmp_path
    made = worker.BackendWorker(CONFIG, bus)
    for k, network in zip(told, ["one", "one", "other", "other"], strict=True):
        descriptor = np.eye(8, dtype=np.float32)[k.id]
        bus.give("depth", depth_of(k, teller, descriptor=descriptor, model=network))
        bus.give("gate", gate_of(k))
        bus.give("keyframe", k)
        made._realtime()
    places = made._mapper.loops.index
    assert (places.network, [k.id in places for k in told]) == ("other", [False, False, True, True])
    life = ListBus("keyframe")
    life.life, life.run_directory = 1, tmp_path
    places = worker.BackendWorker(CONFIG, life)._mapper.loops.index
    assert (places.network, [k.id in places for k in told]) == ("other", [False, False, True, True])


def test_a_stored_map_with_wrong_plain_values_is_refused() -> None:
    _, told = keyframes(3)
    mapper = Mapper(BackendConfig())
    for keyframe in told:
        mapper.absorb(keyframe)
    info, arrays = mapper.stored()
    good = {**info, **KnownScale(0.1, 0.2, network="exact").info}
    assert Mapper(BackendConfig()).restore(good, arrays) == KnownScale(0.1, 0.2, network="exact")
    old = {name: value for name, value in good.items() if name not in ("bias_sigma", "scale_by")}
    assert Mapper(BackendConfig()).restore(old, arrays) == KnownScale(0.1, 0.2, 0.0)
    for wrong in (
        {"epoch": "x"},
        {"epoch": -1},
        {"epoch": True},
        {"log_scale": None},
        {"log_scale": 1e9},
        {"scale_sigma": -1.0},
        {"scale_sigma": "x"},
        {"bias_sigma": -0.1},
    ):
        with pytest.raises(MapError):
            Mapper(BackendConfig()).restore({**good, **wrong}, arrays)
