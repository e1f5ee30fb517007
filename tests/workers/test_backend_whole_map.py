"""The map that a tracker goes on from: all that was said of it before counts."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from prism_edge.backend.journal import Journal
from prism_edge.messages import Epoch, WholeMap
from prism_edge.workers import arrivals
from prism_edge.workers import backend as worker
from tests.workers.backend_bench import CONFIG, depth_of, hear, keyframes
from tests.workers.list_bus import ListBus

pytestmark = pytest.mark.usefixtures("impatient")


def asked_while_busy(bus: ListBus, made: worker.BackendWorker) -> WholeMap | None:
    """What a tracker gets that asked before the backend came back from its work."""
    with ThreadPoolExecutor(1) as tracker:
        answer = tracker.submit(bus.answers["whole_map"])
        while not made._whole.wanted:
            pass
        made.run()
        return answer.result()


@pytest.mark.parametrize("waits", ["for its turn", "for its depth"])
def test_what_a_tracker_said_last_is_in_the_map_that_the_next_one_gets(waits: str, monkeypatch) -> None:
    """Its points' culling, told later, would be undone by the next one, who has never heard of it."""
    if waits == "for its depth":
        monkeypatch.setattr(arrivals, "DEPTH_WAIT_S", 1e6)
    bus, (teller, told) = ListBus("keyframe"), keyframes(5)
    made = worker.BackendWorker(CONFIG, bus)
    hear(made, bus, told[:3], teller)
    bus.give("keyframe", *told[3:])
    if waits == "for its depth":
        made._realtime()
        assert list(made._mapper.world.keyframes) == [0, 1, 2]
    else:
        bus.give("depth", *(depth_of(k, teller) for k in told[3:]))
    given: list[list[int]] = []
    whole = made._keeper.whole
    monkeypatch.setattr(
        made._keeper, "whole", lambda scale: given.append(list(made._mapper.world.keyframes)) or whole(scale)
    )
    assert asked_while_busy(bus, made) is not None
    assert given == [[0, 1, 2, 3, 4]]


def test_a_map_that_was_begun_meanwhile_is_the_one_to_go_on_in() -> None:
    """In the one before, all that the tracker says would be of a map that has gone: passed over for good."""
    bus, (teller, told) = ListBus("keyframe"), keyframes(3)
    made = worker.BackendWorker(CONFIG, bus)
    hear(made, bus, told, teller)
    again, new = keyframes(1, epoch=1, first=3)
    bus.give("depth", depth_of(new[0], again))
    bus.give("keyframe", *new)  # a reset, and its tracker's last word
    whole = asked_while_busy(bus, made)
    assert made._mapper.epoch == 1
    assert whole is not None
    assert whole.epoch == 1


def test_what_was_taken_in_for_it_is_solved_and_no_work_is_said_to_go_on(tmp_path: Path) -> None:
    """Else the journal that a loop has made due would be written for ever, as the supervisor sees it."""
    bus, (teller, told) = ListBus("keyframe"), keyframes(5)
    bus.run_directory = tmp_path
    made = worker.BackendWorker(CONFIG, bus)
    hear(made, bus, told[:3], teller)
    made._keeper.overhauled()  # as a loop does
    bus.give("depth", *(depth_of(k, teller) for k in told[3:]))
    bus.give("keyframe", *told[3:])
    before = len(bus.of("map_update"))
    assert asked_while_busy(bus, made) is not None
    assert "writing the journal" in bus.states
    assert bus.states[-1] == "idle"
    assert [update.based_on for update in bus.of("map_update")[before:]] == [4]


def test_after_a_reset_nobody_goes_on_in_the_map_before(tmp_path: Path) -> None:
    """Though no image has come since that a map could begin with."""
    bus, (teller, told) = ListBus("keyframe"), keyframes(4)
    bus.run_directory = tmp_path
    made = worker.BackendWorker(CONFIG, bus)
    hear(made, bus, told[:3], teller)
    bus.give("new_map", Epoch(1))
    hear(made, bus, told[3:], teller)  # was on its way
    assert made._mapper.epoch == 1
    assert asked_while_busy(bus, made) is None
    bus.desk.ask("save_map", "lab")
    made._desk.serve()
    assert [reply.ok for reply in bus.desk.replies] == [False]
    assert Journal(tmp_path / "journal").recover() is None
    again, new = keyframes(2, epoch=1, first=4)
    bus.give("new_map", Epoch(0), Epoch(1))  # late, or twice
    hear(made, bus, new, again)
    assert list(made._mapper.world.keyframes) == [4, 5]
