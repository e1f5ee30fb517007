"""What is known of keyframes' depths outlives the backend's process, also where it came after them.

What a sensor knows of its own does too: without it they count as a network's.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from prism_edge.messages import IDS_A_LIFE, Keyframe
from prism_edge.workers import arrivals
from prism_edge.workers.backend import BackendWorker
from tests.backend.world import Teller
from tests.workers.backend_bench import CONFIG, depth_of, gate_of, keyframes
from tests.workers.list_bus import ListBus


def backend(folder: Path, number: int) -> tuple[BackendWorker, ListBus]:
    bus = ListBus("keyframe")
    bus.life, bus.first_id, bus.run_directory = number, number * IDS_A_LIFE, folder
    return BackendWorker(CONFIG, bus), bus


def life(folder: Path, number: int, told: list[Keyframe], teller: Teller) -> tuple[dict[int, float], ...]:
    """The noise of each keyframe's depths as a life of the backend finds it, and as it leaves it."""
    made, bus = backend(folder, number)
    found = sigmas(made)
    for keyframe in told:
        bus.give("depth", depth_of(keyframe, teller, frame_sigma=0.03 if keyframe.id % 2 else float("nan")))
        bus.give("gate", gate_of(keyframe))
        bus.give("keyframe", keyframe)
        made._realtime()
    return found, sigmas(made)


def sigmas(made: BackendWorker) -> dict[int, float]:
    return {k: keyframe.depth_sigma for k, keyframe in made._mapper.world.keyframes.items()}


def units(made: BackendWorker) -> dict[int, float]:
    return {k: keyframe.depth_units for k, keyframe in made._mapper.world.keyframes.items()}


def test_it_is_in_the_journal_s_base_and_in_its_tail(tmp_path: Path) -> None:
    teller, told = keyframes(6)
    _, left = life(tmp_path, 0, told[:4], teller)  # the first in the base, the others behind it
    assert left == {0: 0.0, 1: 0.03, 2: 0.0, 3: 0.03}
    found, left = life(tmp_path, 1, told[4:5], teller)  # all in the base
    assert found == {0: 0.0, 1: 0.03, 2: 0.0, 3: 0.03}
    assert life(tmp_path, 2, [], teller)[0] == left


def test_what_a_metre_of_a_network_s_became_is_kept_too_and_a_sensor_s_is_none(tmp_path: Path) -> None:
    teller, told = keyframes(6)
    life(tmp_path, 0, told[:4], teller)  # the first in the base, the others behind it
    found = units(backend(tmp_path, 1)[0])
    assert found[0] > 0.0 < found[2]
    assert found[1] == found[3] == 0.0
    life(tmp_path, 1, told[4:5], teller)  # all in the base
    assert units(backend(tmp_path, 2)[0]) == {**found, 4: found[2]}


def test_of_two_networks_the_later_s_metres_count(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """After a reload with another one: each has metres of its own."""
    teller, told = keyframes(6)
    made, bus = backend(tmp_path, 0)

    def tell(keyframe: Keyframe, model: str) -> None:
        bus.give("depth", depth_of(keyframe, teller, model=model))
        bus.give("gate", gate_of(keyframe))
        bus.give("keyframe", keyframe)
        made._realtime()

    for keyframe in told[:3]:
        tell(keyframe, "first 1 (0123456789ab)")
    assert all(units(made).values())
    tell(told[3], "second 1 (ba9876543210)")
    assert [u > 0.0 for u in units(made).values()] == [False, False, False, True]
    monkeypatch.setattr(arrivals, "DEPTH_WAIT_S", 0.0)
    bus.give("keyframe", told[4])
    made._realtime()
    bus.give("depth", depth_of(told[4], teller, model="third 1 (001122334455)"))  # comes late
    made._realtime()
    assert [u > 0.0 for u in units(made).values()] == [False, False, False, False, True]


def test_what_comes_after_its_keyframe_is_in_the_journal_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(arrivals, "DEPTH_WAIT_S", 0.0)
    teller, told = keyframes(6)
    told[5] = replace(told[5], culled_keyframes=np.array([2]))
    made, bus = backend(tmp_path, 0)
    for keyframe in told[:4]:
        bus.give("keyframe", keyframe)
        made._realtime()
    tail = tmp_path / "journal" / "tail"
    before = tail.stat().st_size
    bus.give("depth", depth_of(told[0], teller, valid=False), depth_of(told[3], teller, epoch=4))
    made._realtime()
    assert tail.stat().st_size == before, "nothing has come of them"
    looks = np.eye(8, dtype=np.float32)
    for k in (0, 1, 2):  # the first is in the base
        bus.give("depth", depth_of(told[k], teller, frame_sigma=0.03, descriptor=looks[k], model="exact"))
    bus.give("gate", gate_of(told[1], 0.25))
    made._realtime()
    bus.give("keyframe", told[4])
    made._realtime()
    bus.give("keyframe", told[5])  # and without the one that is culled with it
    made._realtime()
    recovered, _ = backend(tmp_path, 1)
    left, found = made._mapper, recovered._mapper
    assert list(found.world.keyframes) == list(left.world.keyframes) == [0, 1, 3, 4, 5]
    assert {k: set(v.observed) for k, v in found.world.keyframes.items()} == {
        k: set(v.observed) for k, v in left.world.keyframes.items()
    }, "none was absorbed twice"
    assert sigmas(recovered) == sigmas(made) == {0: 0.03, 1: 0.03, 3: 0.0, 4: 0.0, 5: 0.0}
    for k in (0, 1):
        there, here = found.world.keyframes[k], left.world.keyframes[k]
        assert there.depths is not None
        np.testing.assert_allclose(there.depths, here.depths, rtol=1e-6)
        np.testing.assert_allclose(found.loops.index.get(k), looks[k])
    assert found.world.keyframes[1].gate_weight(1) == 0.25
    assert 2 not in found.loops.index


def test_a_map_that_is_to_be_written_as_a_whole_needs_no_record_of_what_is_late(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(arrivals, "DEPTH_WAIT_S", 0.0)
    teller, told = keyframes(4)
    made, bus = backend(tmp_path, 0)
    for keyframe in told[:3]:
        bus.give("keyframe", keyframe)
        made._realtime()
    tail = tmp_path / "journal" / "tail"
    before = tail.stat().st_size
    made._keeper.overhauled()
    bus.give("depth", depth_of(told[1], teller, frame_sigma=0.03))
    made._receive(0.0)
    assert tail.stat().st_size == before
    made._realtime()
    assert sigmas(backend(tmp_path, 1)[0]) == {0: 0.0, 1: 0.03, 2: 0.0}, "the new base has it"
    bus.give("keyframe", told[3])
    made._realtime()
    assert sigmas(backend(tmp_path, 1)[0]) == {0: 0.0, 1: 0.03, 2: 0.0, 3: 0.0}
