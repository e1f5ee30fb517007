"""The tracker worker while no frame waits: what it takes in, and how it ends."""

from __future__ import annotations

import pytest

from prism_edge.messages import EndOfStream
from prism_edge.workers.tracker import TrackerWorker
from tests.workers.tracker_bench import CONFIG, LOCKSTEP, frame, run


@pytest.mark.parametrize(("config", "rouses"), [(CONFIG, True), (LOCKSTEP, False)])
def test_answers_are_taken_in_between_frames_in_real_time_alone(bus, config, rouses):
    """A frame that has come need not wait for them; in lockstep each has its own frame."""
    TrackerWorker(config, bus)
    frames = bus.inboxes["frame"]
    for topic in ("depth", "log_scale", "map_update"):
        assert (bus.inboxes[topic].rouses is frames) == rouses


def test_a_frame_that_comes_behind_the_end_does_not_hide_it(bus):
    worker = TrackerWorker(CONFIG, bus)
    bus.give("end", EndOfStream(3, 3, 0, 0, 2))
    worker._note_end()
    bus.pulse.idle()  # as after a frame
    worker._note_end()
    assert bus.states[-1] == "ended"


def test_it_notes_the_end_and_stays(bus, world):
    bus.give("end", EndOfStream(3, 3, 0, 0, 2))
    run(bus, [frame(i) for i in range(3)])
    assert "ended" in bus.states
    assert len(bus.of("tracked")) == 3
