"""Depth was started anew with another `depth.model`: what the tracker, which lives on, makes of it."""

from __future__ import annotations

import numpy as np

from prism_edge.messages import Depth, KeyframeImage
from prism_edge.workers.tracker import TrackerWorker
from tests.workers.list_bus import ListBus
from tests.workers.tracker_bench import CONFIG, World, depth_of, frame


def test_places_are_in_the_new_network_s_words() -> None:
    bus = ListBus("frame")
    world, shown = World(bus), []

    def answer(image: KeyframeImage) -> Depth:
        shown.append(image.keyframe)
        network = "one" if len(shown) < 3 else "other"
        return depth_of(image, descriptor=np.eye(8, dtype=np.float32)[len(shown)], model=network)

    world.depth = answer
    made = TrackerWorker(CONFIG, bus)
    bus.give("frame", *(frame(i) for i in range(75)))
    made.run()
    assert 8 > len(shown) >= 4
    places = made._tracker.places.index
    assert places.network == "other"
    assert [k for k in shown if k in places] == shown[2:]
