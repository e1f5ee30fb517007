"""What a sensor knows of its depths outlives the backend's process: without it they count as a network's."""

from __future__ import annotations

from pathlib import Path

from prism_edge.messages import IDS_A_LIFE, Keyframe
from prism_edge.workers.backend import BackendWorker
from tests.backend.world import Teller
from tests.workers.backend_bench import CONFIG, depth_of, gate_of, keyframes
from tests.workers.list_bus import ListBus


def life(folder: Path, number: int, told: list[Keyframe], teller: Teller) -> tuple[dict[int, float], ...]:
    """The noise of each keyframe's depths as a life of the backend finds it, and as it leaves it."""
    bus = ListBus("keyframe")
    bus.life, bus.first_id, bus.run_directory = number, number * IDS_A_LIFE, folder
    made = BackendWorker(CONFIG, bus)
    found = sigmas(made)
    for keyframe in told:
        bus.give("depth", depth_of(keyframe, teller, frame_sigma=0.03 if keyframe.id % 2 else float("nan")))
        bus.give("gate", gate_of(keyframe))
        bus.give("keyframe", keyframe)
        made._realtime()
    return found, sigmas(made)


def sigmas(made: BackendWorker) -> dict[int, float]:
    return {k: keyframe.depth_sigma for k, keyframe in made._mapper.world.keyframes.items()}


def test_it_is_in_the_journal_s_base_and_in_its_tail(tmp_path: Path) -> None:
    teller, told = keyframes(6)
    _, left = life(tmp_path, 0, told[:4], teller)  # the first in the base, the others behind it
    assert left == {0: 0.0, 1: 0.03, 2: 0.0, 3: 0.03}
    found, left = life(tmp_path, 1, told[4:5], teller)  # all in the base
    assert found == {0: 0.0, 1: 0.03, 2: 0.0, 3: 0.03}
    assert life(tmp_path, 2, [], teller)[0] == left
