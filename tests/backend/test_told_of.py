"""What a keyframe message says of parts that were joined, and by which camera it is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from prism_edge.backend.global_map import GlobalMap
from prism_edge.geometry.cameras import Camera
from prism_edge.messages import HOME
from tests.backend.world import Teller, check, quiet
from tests.tracking.cloud import CAMERA, pose_at


def test_keyframes_of_a_part_that_was_joined_are_of_the_older_one():
    """Else the next loop would give its unit to a part that nothing new is of."""
    teller, world = Teller(), GlobalMap()
    parts = [HOME, 1, 2, 2]
    for i, part in enumerate(parts):
        message = replace(teller.keyframe(pose_at(0.2 * i)), part=part)
        world.absorb(message)
    world.part_grew(2, 1.5)
    joined = {"joined": np.array([[2, 1]]), "joined_units": np.zeros((1, 2))}
    world.absorb(replace(quiet(message), part=1, **joined))
    assert [world.keyframes[k].part for k in range(5)] == [HOME, 1, 1, 1, 1]
    assert not world.growth


@pytest.mark.parametrize("other", [replace(CAMERA, width=320), replace(CAMERA, fx=400.0)])
def test_another_camera_s_keyframe_keeps_its_camera_and_its_pixels(other: Camera):
    """A lens that was found is the one camera's: a map may be gone on with by another."""
    teller, world = Teller(), GlobalMap()
    for i in range(3):
        world.absorb(teller.keyframe(pose_at(0.2 * i)))
    world.take_lens(CAMERA.bent(-0.03))
    message = teller.keyframe(pose_at(0.6))
    added = world.absorb(replace(message, camera=other.to_array()))
    assert added.camera == other
    assert np.array_equal(added.pixels, message.pixels.astype(np.float64))
    world.take_lens(CAMERA.bent(-0.05))
    assert world.keyframes[0].camera == CAMERA.bent(-0.05)
    assert added.camera == other
    assert np.array_equal(added.pixels, message.pixels.astype(np.float64))


def test_of_two_points_made_one_the_other_way_round_the_name_that_the_tracker_keeps_counts():
    """By the other it would know none of the corrections that the point gets."""
    teller, world = Teller(), GlobalMap()
    messages = [teller.keyframe(pose_at(0.2 * i)) for i in range(3)]
    for message in messages:
        world.absorb(message)
    kept, gone = messages[0].points[:2].tolist()
    for k in range(3):  # no keyframe tells them apart
        world.keyframes[k].observed.pop(gone if k else kept, None)
        world.points[gone if k else kept].keyframes.discard(k)
    world.fuse(kept, gone)  # a loop's, of which the tracker has not heard
    assert kept not in world.points
    world.absorb(quiet(messages[-1], fused_from=[gone], fused_into=[kept]))
    assert kept in world.points
    assert gone not in world.points
    assert world.points[kept].keyframes == {0, 1, 2}
    check(world)


def test_once_a_camera_s_readout_was_said_it_is_said_for_good():
    teller, world = Teller(), GlobalMap()
    for said, known in ((False, False), (True, True), (False, True)):
        world.absorb(replace(teller.keyframe(pose_at(0.2 * len(teller.poses))), readout_said=said))
        assert world.readout_said == known
