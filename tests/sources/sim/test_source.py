"""The simulator as a source: the same verbs as a recording, exact truth, equal by seed."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from prism_edge.bus import ros
from prism_edge.config import Config, SourceConfig
from prism_edge.errors import ConfigError, SourceError
from prism_edge.geometry.poses import inverse
from prism_edge.sources import Image, open_source
from prism_edge.sources.sim import SimSource
from prism_edge.sources.sim.effects import EXPOSURE_S
from prism_edge.sources.sim.paths import lap_length
from prism_edge.sources.truth import read_truth
from prism_edge.workers.source import SourceWorker
from tests.workers.list_bus import ListBus

TINY = "width=96&height=72"


def test_it_plays_like_a_recording() -> None:
    with open_source(SourceConfig(uri=f"sim:room?frames=5&rate=10&{TINY}")) as source:
        assert source.frame_count == 5
        assert source.period_ns == 100_000_000
        assert not source.live
        assert (source.camera.width, source.camera.height, source.camera.fx) == (96, 72, 525 * 96 / 640)
        first = source.read()
        assert isinstance(first, Image)
        assert first.pixels.shape == (72, 96, 3)
        assert first.pixels.dtype == np.uint8
        source.skip()
        slot = source.peek()
        assert slot is not None
        assert (slot.index, slot.stamp_ns) == (2, 200_000_000)
        indices = []
        while (item := source.read()) is not None:
            indices.append(item.index)
        assert indices == [2, 3, 4]
        assert source.peek() is None


def test_it_can_be_looped_and_opened_again() -> None:
    uri = f"sim:static?frames=2&noise=0&blur=0&exposure=0&{TINY}"
    with open_source(SourceConfig(uri=uri, loop=True)) as source:
        items = [source.read() for _ in range(5)]
        assert [item.index for item in items if item is not None] == [0, 1, 2, 3, 4]


def test_equal_seeds_give_equal_pictures_in_any_order() -> None:
    uri = f"sim:room?seed=9&actors=2&frames=40&{TINY}"
    with SimSource(uri) as first, SimSource(uri) as second:
        forwards = [first.image(k).pixels for k in (3, 17, 31)]
        backwards = [second.image(k).pixels for k in (31, 17, 3)][::-1]
        assert all(np.array_equal(a, b) for a, b in zip(forwards, backwards, strict=True))
        assert np.array_equal(first.depth(17), second.depth(17))
        with SimSource(uri.replace("seed=9", "seed=10")) as other:
            assert not np.array_equal(first.pose(17), other.pose(17))
            assert np.abs(first.image(17).pixels.astype(int) - other.image(17).pixels).mean() > 10


def test_equal_seeds_give_equal_rings(loop: SimSource) -> None:
    with SimSource("sim:loop?seed=6&actors=3&width=160&height=120&noise=0&blur=0&exposure=0") as again:
        for index in (700, 20):
            assert np.array_equal(again.image(index).pixels, loop.image(index).pixels)
            assert np.array_equal(again.pose(index), loop.pose(index))


def test_equal_seeds_give_equal_streets(street: SimSource) -> None:
    uri = "sim:street?seed=4&rate=10&width=160&height=120&noise=0&blur=0&exposure=0"
    with SimSource(uri) as again, SimSource(uri.replace("seed=4", "seed=5")) as other:
        for index in (200, 3):
            assert np.array_equal(again.image(index).pixels, street.image(index).pixels)
        assert np.abs(other.image(3).pixels.astype(int) - street.image(3).pixels).mean() > 10


def test_a_drive_is_a_lap_and_something_seen_again(street: SimSource) -> None:
    lap = lap_length(street.path)
    _, way = street.truth()
    driven = np.linalg.norm(np.diff(way[:, :3, 3], axis=0), axis=1).sum()
    assert lap + 20.0 < driven < lap + 60.0
    faster = SimSource("sim:street?seed=4&rate=10&speed=18").frame_count
    assert 0.5 * street.frame_count < faster < 0.9 * street.frame_count  # bends take as long


def test_people_and_faults_leave_the_way_alone() -> None:
    plain = SimSource("sim:room?seed=2&noise=0&blur=0&exposure=0")
    full = SimSource("sim:room?seed=2&actors=3")
    assert np.array_equal(plain.truth()[1], full.truth()[1])


def test_truth_needs_no_world_and_is_what_scorers_read() -> None:
    uri = "sim:loop?seed=4&frames=50&rate=20"
    source = SimSource(uri)
    stamps, poses = source.truth()
    assert stamps.tolist() == [k * 50_000_000 for k in range(50)]
    assert np.array_equal(poses[7], source.pose(7))
    read = read_truth(uri)
    assert read is not None
    assert np.array_equal(read[0], stamps)
    assert np.array_equal(read[1], poses)


@pytest.mark.parametrize("path", ["turn", "handheld"])
def test_a_smeared_picture_is_the_mean_over_its_exposure(path: str) -> None:
    """The stamp is the middle of the exposure: what sharp pictures round it add up to."""
    strength, index = 5, 25
    uri = f"sim:room?seed=5&path={path}&width=320&height=240&noise=0&exposure=0&blur={strength}"
    with SimSource(uri) as source:
        renderer, _ = source._opened()
        seconds, span = source.stamp_ns(index) * 1e-9, strength * EXPOSURE_S

        def sharp(pose: np.ndarray) -> np.ndarray:
            return renderer.draw(pose, {}).pixels[20:-20, 20:-20, :3].astype(float)

        def mean_about(middle: float) -> np.ndarray:
            times = middle + span * (np.arange(16) + 0.5) / 16 - span / 2
            return np.mean([sharp(source.path.pose(float(t))) for t in times], axis=0)

        out = source.image(index).pixels[20:-20, 20:-20]
        right, early, late = (np.abs(out - mean_about(seconds + s * span)).mean() for s in (0.0, -0.4, 0.4))
        unsmeared = np.abs(out - sharp(source.pose(index))).mean()
        assert right < 0.5 * min(early, late, unsmeared)


def test_refusals() -> None:
    with pytest.raises(SourceError, match="castle"):
        open_source(SourceConfig(uri="sim:castle"))
    with pytest.raises(ConfigError, match="camera"):
        open_source(SourceConfig(uri="sim:room", camera="camera.yaml"))
    with pytest.raises(SourceError, match="not open"):
        SimSource("sim:room").image(0)


def test_the_truth_of_each_frame_is_published() -> None:
    uri = f"sim:room?frames=3&rate=100&{TINY}"
    config = replace(Config(), source=SourceConfig(uri=uri))
    bus: Any = ListBus()
    bus.pulse.ended = bus.stopped.set
    with open_source(config.source) as source:
        SourceWorker(config, bus, source).run()
    frames, truths = [frame.stamp_ns for frame in bus.of("frame")], bus.of("truth")
    assert frames
    assert [ros.stamp_ns(message) for message in truths] == frames
    simulated = SimSource(uri)
    for stamp, message in zip(frames, truths, strict=True):
        pose = simulated.pose(round(stamp / 1e7))
        assert inverse(pose) @ ros.pose_matrix(message.pose) == pytest.approx(np.eye(4), abs=1e-9)
        assert message.header.frame_id == "simulated_world"
