"""What the depth network is shown of a camera, and what again."""

from __future__ import annotations

import numpy as np
import pytest

from prism_edge.bus import ros
from prism_edge.config import FramesConfig
from prism_edge.geometry.mount import base_from_camera, looking
from prism_edge.messages import DEGRADED, OK, KeyframeImage
from prism_edge.tracking.depth_watch import SILENT_NS, DepthWatch
from prism_edge.workers.pictures import PROBE_NS, Pictures
from prism_edge.workers.tracker import TrackerWorker
from tests.tracking.footage import footage
from tests.workers.list_bus import ListBus
from tests.workers.tracker_bench import CONFIG, World, frame

SHOWN_NS = 1_000_000_000
MOUNT = base_from_camera(FramesConfig())


def shown(bus: ListBus) -> list[int]:
    return [picture.keyframe for picture in bus.of("keyframe_image")]


@pytest.fixture
def bus() -> ListBus:
    return ListBus()


def test_a_picture_without_an_answer_is_shown_again_and_again_until_there_is_one(bus: ListBus) -> None:
    pictures, watch = Pictures(bus, answered=True, mount=MOUNT), DepthWatch()
    pictures.once_more(SHOWN_NS, watch)
    assert shown(bus) == []
    pictures.keyframe(frame(0, stamp_ns=SHOWN_NS), 7, 2, watch)
    for n in (1, 2):
        pictures.once_more(SHOWN_NS + n * (SILENT_NS + 1) - 1, watch)
        assert shown(bus) == n * [7]
        pictures.once_more(SHOWN_NS + n * (SILENT_NS + 1), watch)
        assert shown(bus) == (n + 1) * [7]
    first, _, again = bus.of("keyframe_image")
    assert (again.epoch, again.index, again.stamp_ns) == (first.epoch, first.index, first.stamp_ns)
    assert np.array_equal(again.image, first.image)
    watch.depth(7, True, "")
    pictures.once_more(SHOWN_NS + 100 * SILENT_NS, watch)
    assert shown(bus) == [7, 7, 7]


def test_only_the_newest_is_and_only_in_the_map_that_it_is_of(bus: ListBus) -> None:
    pictures, watch = Pictures(bus, answered=True, mount=MOUNT), DepthWatch()
    for number in (7, 8):
        pictures.keyframe(frame(number, stamp_ns=SHOWN_NS), number, 2, watch)
    pictures.once_more(SHOWN_NS + 2 * SILENT_NS, watch)
    assert shown(bus) == [7, 8, 8]
    pictures.once_more(SHOWN_NS + 4 * SILENT_NS, DepthWatch())
    assert shown(bus) == [7, 8, 8]


def test_where_nobody_answers_nothing_is_waited_for(bus: ListBus) -> None:
    pictures, watch = Pictures(bus, answered=False, mount=MOUNT), DepthWatch()
    pictures.keyframe(frame(0, stamp_ns=SHOWN_NS), 7, 2, watch)
    assert pictures.probe(frame(1), 2) is None
    pictures.once_more(SHOWN_NS + 2 * SILENT_NS, watch)
    assert shown(bus) == [7]
    assert watch.trouble(SHOWN_NS + 100 * SILENT_NS) == ""


def test_a_lost_camera_is_looked_at_now_and_then(bus: ListBus) -> None:
    pictures = Pictures(bus, answered=True, mount=MOUNT)
    stamps = [0, PROBE_NS - 1, PROBE_NS, 2 * PROBE_NS - 1, 2 * PROBE_NS]
    probes = [pictures.probe(frame(i, stamp_ns=stamp), 2) for i, stamp in enumerate(stamps)]
    assert [probe is not None for probe in probes] == [True, False, True, False, True]
    assert all(number < 0 for number in shown(bus))
    assert len(set(shown(bus))) == 3


@pytest.mark.parametrize(("roll", "turns"), [(0, 0), (90, 3), (180, 2), (-90, 1)])
def test_each_picture_says_how_it_is_to_be_turned_upright(bus: ListBus, roll: int, turns: int) -> None:
    mount = base_from_camera(FramesConfig(base_from_camera_xyzw=tuple(looking(roll_deg=roll))))
    pictures = Pictures(bus, answered=True, mount=mount)
    pictures.keyframe(frame(0), 7, 2, DepthWatch())
    pictures.probe(frame(1), 2)
    assert [picture.turns for picture in bus.of("keyframe_image")] == [turns, turns]


def test_a_robot_that_was_parked_while_the_network_was_away_is_degraded_no_longer_than_that() -> None:
    """It makes no keyframe that could be answered instead."""
    bus = ListBus("frame")
    world = World(bus)
    worker, rng, film = TrackerWorker(CONFIG, bus), np.random.default_rng(0), footage()
    away: list[KeyframeImage] = []

    def feed(index: int, of: int, at_s: float) -> str:
        worker._take_in(-1)
        image = film.images[of] + np.round(rng.normal(0.0, 2.0, film.images[of].shape))
        picture = np.clip(image, 0, 255).astype(np.uint8)
        worker._track(frame(index, of=of, stamp_ns=round(at_s * 1e9), image=picture))
        return str(bus.of("status")[-1].status[0].message).split()[0]

    def nobody(topic: str, message: object) -> None:
        if topic == "keyframe_image":
            away.append(message)  # type: ignore[arg-type]
        else:
            world.heard(topic, message)

    for index in range(60):
        bus.hear = world.heard if index < 45 else nobody
        said = feed(index, index, index / 30)
    assert away
    assert said == OK
    for index in range(60, 100):  # parked
        said = feed(index, 59, index / 30 + 0.2 * (index - 59))
    assert said == DEGRADED
    bus.hear = world.heard  # it is back
    for index in range(100, 135):
        said = feed(index, 59, index / 30 + 0.2 * (index - 59))
    assert said == OK
    assert bus.of("status")[-1].status[0].level == ros.LEVEL_OK
