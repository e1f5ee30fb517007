"""A frame that its second view moves, after its pose has gone out: where the others have it."""

from __future__ import annotations

import numpy as np

from tests.tracking.footage import footage
from tests.workers.list_bus import ListBus
from tests.workers.tracker_bench import World, depth_of, frame, run

START = 15


def test_the_frame_is_told_where_the_second_view_has_it(bus: ListBus, world: World, caplog) -> None:
    depth = footage().depths[START]
    reversed_depth = (np.median(depth) ** 2 / depth).astype(np.float32)  # what is near is far
    world.depth = lambda image: (
        depth_of(image, depth=reversed_depth) if image.index == 0 else depth_of(image, START + image.index)
    )
    with caplog.at_level("INFO", "prism_edge.tracking"):
        run(bus, [frame(i, START + i) for i in range(20)])
    assert "the first map rests on two views" in caplog.text
    first, second = bus.of("keyframe")[:2]
    (told,) = (tracked for tracked in bus.of("tracked") if tracked.keyframe == second.id)
    assert told.reference == first.id
    carried = first.world_from_camera @ told.reference_from_camera
    assert np.allclose(carried, second.world_from_camera, atol=1e-9)
