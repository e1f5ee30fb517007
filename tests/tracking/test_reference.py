"""Which keyframe the camera is at."""

from __future__ import annotations

from prism_edge.tracking.local_map import LocalMap
from prism_edge.tracking.reference import Reference
from prism_edge.tracking.submaps import Parts
from tests.tracking.cloud import Cloud, pose_at


def walked(count: int = 3) -> tuple[LocalMap, Parts]:
    """Keyframes 0, 1, ... on a way along the view, each half a metre nearer to what it sees."""
    world, _ = Cloud().mapped([pose_at(0.0, 0.0, 0.5 * k) for k in range(count)])
    return world, Parts()


def test_it_is_the_newest_until_the_camera_is_back_at_another() -> None:
    world, parts = walked()
    at = Reference()
    assert at.keyframe(world, parts) is world.keyframes[2]
    at.matches = 70
    at.move_to(world.keyframes[0], world, parts, 5)
    assert at.keyframe(world, parts) is world.keyframes[0]
    assert (at.since_ns, at.matches) == (5, 0)
    assert at.depth == world.median_depth(world.keyframes[0]) > world.median_depth(world.keyframes[2])
    at.leave()
    assert at.keyframe(world, parts) is world.keyframes[2]
    assert at.since_ns == 5


def test_at_the_newest_it_goes_along_with_what_comes() -> None:
    world, parts = walked(2)
    at = Reference()
    at.move_to(world.keyframes[1], world, parts, 5)
    more, parts = walked(3)
    assert at.keyframe(more, parts) is more.keyframes[2]


def test_one_that_was_culled_gives_way_to_the_newest() -> None:
    world, parts = walked()
    at = Reference()
    at.move_to(world.keyframes[0], world, parts, 5)
    del world.keyframes[0]
    assert at.keyframe(world, parts) is world.keyframes[2]


def test_a_new_keyframe_is_where_the_camera_is() -> None:
    world, parts = walked()
    at = Reference()
    at.move_to(world.keyframes[0], world, parts, 5)
    at.matches = 70
    at.renew(9)
    assert at.keyframe(world, parts) is world.keyframes[2]
    assert (at.since_ns, at.matches) == (9, 0)


def test_the_newest_is_that_of_the_part_that_the_camera_is_in() -> None:
    world, _ = walked()
    parts = Parts.given({2: 2})
    assert Reference().keyframe(world, parts) is world.keyframes[1]
