"""What the backend shows of its map."""

from __future__ import annotations

import numpy as np

from prism_edge.backend.mapper import Mapper
from prism_edge.config import BackendConfig
from prism_edge.geometry.cameras import PINHOLE, Camera
from prism_edge.geometry.poses import inverse
from prism_edge.messages import HOME
from prism_edge.workers.map_snapshot import snapshot
from tests.backend.world import CAMERA, chain, poses_of
from tests.tracking.cloud import pose_at


def test_what_was_culled_is_counted_and_what_nothing_has_joined_is_named() -> None:
    mapper = Mapper(BackendConfig(), use_depth=False)
    world = mapper.world
    for part, start in ((HOME, 0), (50, 50), (100, 100)):
        chain([pose_at(start + 0.3 * i) for i in range(4)], start, world)
        for k in range(start, start + 4):
            world.keyframes[k].part = HOME if part == 50 else part  # that was joined, in another unit
            world.keyframes[k].grown = 1.5 if part == 50 else 1.0
    before = poses_of(world)
    for k in (2, 51, 102):
        world._forget_keyframe(k)
    shown = snapshot(mapper, True, 0.2)
    held = [0, 1, 3, 50, 52, 53, 100, 101, 103]
    assert shown.keyframes[: len(held)].tolist() == held
    assert sorted(shown.keyframes[len(held) :].tolist()) == [2, 51, 102]
    assert shown.carried == 3
    assert sorted(shown.away.tolist()) == [100, 101, 102, 103]
    grown = dict(zip(shown.keyframes.tolist(), shown.grown.tolist(), strict=True))
    assert grown == {k: 1.5 if 50 <= k < 54 else 1.0 for k in grown}
    for k, pose in zip(shown.keyframes.tolist(), shown.poses, strict=True):
        assert np.abs(inverse(before[k]) @ pose - np.eye(4)).max() < 1e-9
    assert (shown.settled, shown.log_scale) == (True, 0.2)


def test_what_was_found_of_the_camera_is_shown() -> None:
    mapper = Mapper(BackendConfig(), use_depth=False)
    chain([pose_at(0.3 * i) for i in range(4)], 0, mapper.world)
    shown = snapshot(mapper, True, 0.0)
    assert np.array_equal(shown.camera, CAMERA.to_array())
    assert shown.readout_ms == 0.0
    lens = Camera.from_array(PINHOLE, CAMERA.bent(-0.02).to_array())
    mapper.world.take_lens(lens)
    mapper.world.readout_ms = 25.2
    shown = snapshot(mapper, True, 0.0)
    assert np.array_equal(shown.camera, lens.to_array())
    assert shown.readout_ms == 25.2
