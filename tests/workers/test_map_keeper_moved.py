"""The journal of a map that moved as a whole: a backend started again right after must not take that back."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from prism_edge.backend import map_file
from prism_edge.backend.map_scale import KnownScale
from prism_edge.config import Config, StateConfig, TrackingConfig
from prism_edge.errors import MapError
from prism_edge.messages import IDS_A_LIFE
from prism_edge.workers import backend as worker
from tests.backend.ring import Ring
from tests.synthetic import messages
from tests.workers.backend_bench import CONFIG, LOCKSTEP, QUARTER, gate_of, hear, keyframes, snapshot
from tests.workers.list_bus import ListBus

DRIFT = np.array([0.012, 0.006, -0.012, 0.002, -0.004, 0.002])


def life(folder: Path, number: int = 0, config: Config = CONFIG) -> tuple[ListBus, worker.BackendWorker]:
    bus = ListBus("keyframe", "tracked")
    bus.life, bus.first_id, bus.run_directory = number, number * IDS_A_LIFE, folder
    return bus, worker.BackendWorker(config, bus)


def moved(made: worker.BackendWorker) -> float:
    """Move all of its map as a loop would; where its second keyframe is then."""
    for keyframe in made._mapper.world.keyframes.values():
        keyframe.world_from_camera = keyframe.world_from_camera.copy()
        keyframe.world_from_camera[0, 3] += 5.0
    made._keeper.overhauled()
    return float(made._mapper.world.keyframes[1].world_from_camera[0, 3])


def recovered(folder: Path) -> float:
    """Where the next life has that keyframe."""
    return float(snapshot(life(folder, 1)[0]).poses[1][0, 3])


@pytest.mark.parametrize("config", [CONFIG, LOCKSTEP])
def test_a_map_that_moved_as_a_whole_is_written_as_soon_as_nothing_waits(
    tmp_path: Path, config: Config
) -> None:
    teller, told = keyframes(3)
    bus, made = life(tmp_path, config=config)
    hear(made, bus, told, teller)
    there = moved(made)
    (made._realtime if made._ticks is None else made._lockstep)()
    assert recovered(tmp_path) == pytest.approx(there)
    assert bus.states[-1] == "idle", "writing is over"


def test_a_map_that_moved_in_the_last_piece_of_work_is_written_at_the_stop(tmp_path: Path) -> None:
    teller, told = keyframes(3)
    bus, made = life(tmp_path)
    hear(made, bus, told, teller)
    there = moved(made)
    bus.stopped.set()
    made.run()
    assert recovered(tmp_path) == pytest.approx(there)


def test_it_is_written_once_however_long_nothing_comes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    teller, told = keyframes(3)
    bus, made = life(tmp_path)
    hear(made, bus, told, teller)
    written, write = [], map_file.write
    monkeypatch.setattr(map_file, "write", lambda *a, **k: (written.append(a[0]), write(*a, **k)))
    moved(made)
    for _ in range(5):
        made._realtime()
    assert len(written) == 1


def test_a_loop_that_was_just_told_is_in_the_map_of_the_next_life(tmp_path: Path) -> None:
    ring = Ring(drift=DRIFT, stretch=1.004)
    bus, made = life(tmp_path)
    while not any(update.loop_query >= 0 for update in bus.of("map_update")):
        keyframe = ring.keyframe()
        looks = {"valid": False, "descriptor": ring.looks_like(keyframe.id)}
        bus.give("depth", messages.depth_of(keyframe, np.ones((120, 160), np.float32), QUARTER, **looks))
        bus.give("gate", gate_of(keyframe))
        bus.give("keyframe", keyframe)
        made._realtime()
    made._realtime()
    update = bus.of("map_update")[-1]
    after = snapshot(life(tmp_path, 1)[0])
    assert after.keyframes.tolist() == update.keyframes.tolist()
    np.testing.assert_allclose(after.poses, update.poses, atol=1e-9)


def full(*_: object, **__: object) -> None:
    raise MapError("can't write base: No space left on device")


@pytest.mark.parametrize("moves", ["before it is full", "while it is full", "not at all"])
def test_on_a_full_disk_no_map_is_left_that_contradicts_the_tracker_s(
    tmp_path: Path, moves: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    teller, told = keyframes(6)
    bus, made = life(tmp_path)
    hear(made, bus, told[:4], teller)
    if moves.startswith("before"):
        moved(made)
    else:
        made._keeper._journal.close()  # as where a record could not be written
    monkeypatch.setattr(map_file, "write", full)
    hear(made, bus, told[4:], teller)
    if moves.startswith("while"):
        moved(made)
    assert "No space left" in bus.pulse.values["journal"]
    left = [0, 1, 2, 3] if moves == "not at all" else []
    assert snapshot(life(tmp_path, 1)[0]).keyframes.tolist() == left


@pytest.mark.parametrize("is_full", ["already", "since"])
def test_on_a_full_disk_the_map_before_a_reset_is_not_gone_on_in(
    tmp_path: Path, is_full: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    teller, told = keyframes(6)
    bus, made = life(tmp_path)
    hear(made, bus, told[:3], teller)
    monkeypatch.setattr(map_file, "write", full)
    if is_full == "already":
        made._keeper._journal.close()
    hear(made, bus, told[3:4], teller)
    hear(made, bus, [replace(k, epoch=1) for k in told[4:]], teller)
    assert len(made._mapper.world.keyframes) == 2
    assert snapshot(life(tmp_path, 1)[0]).keyframes.tolist() == []


def test_a_map_loaded_while_the_disk_is_full_leaves_none_of_the_one_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Else the next life would go on in a map that the tracker has left."""
    state = StateConfig(directory=str(tmp_path / "state"))
    config = replace(CONFIG, state=state, tracking=TrackingConfig(scale_factor=1.2, levels=8))
    teller, told = keyframes(4)
    bus, made = life(tmp_path, config=config)
    hear(made, bus, told[:3], teller)
    made._keeper.save("lab", KnownScale())
    hear(made, bus, told[3:], teller)
    assert snapshot(life(tmp_path, 1, config)[0]).keyframes.tolist() == [0, 1, 2, 3]

    monkeypatch.setattr(map_file, "write", full)
    made._keeper.load("lab")
    assert "journal" in bus.pulse.values
    assert snapshot(life(tmp_path, 1, config)[0]).keyframes.tolist() == []
