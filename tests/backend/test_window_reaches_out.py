"""A window that one pose holds of a map which lies behind a quick turn: its size is the map's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from prism_edge.backend import window as module
from prism_edge.backend.global_map import GlobalMap
from prism_edge.backend.mapper import Mapper
from prism_edge.backend.second_start import of_network, second_start
from prism_edge.backend.window import LEAST_SAID, Window, choose_window, placed_elsewhere, solve
from prism_edge.geometry.poses import Array
from tests.backend.test_window import CONFIG, world_of
from tests.backend.world import depth_at_keypoints
from tests.tracking.cloud import pose_at

HELD = 4  # the newest of the map behind
OFTEN = replace(CONFIG, iterations=100)


def turned(factor: float, shared: int = 30) -> GlobalMap:
    """Five keyframes, and four on new ground that is ``factor`` times too large about the last of the five.

    Only that one sees something of both, and ``shared`` points of the new ground, as the first there does.
    """
    behind = [pose_at(0.2 * i) for i in range(HELD + 1)]
    drive = [pose_at(0.8 + 0.1 * i, 0.02 * i, 0.05 * i) for i in range(1, 5)]
    world, teller = world_of(behind + drive)
    depth_at_keypoints(world, teller.cloud, teller.poses)
    old = set(sorted(world.points)[::2])
    both = set(sorted(p for p, point in world.points.items() if {HELD, HELD + 1} <= point.keyframes)[1::2])
    both = set(sorted(both - old)[:shared])
    for p in sorted(world.points):
        for k in sorted(world.points[p].keyframes):
            seen = k <= HELD if p in old else k in (HELD, HELD + 1) if p in both else k > HELD
            if not seen:
                world.drop_observation(k, p)
    centre = world.keyframes[HELD].world_from_camera[:3, 3].copy()
    for k in range(HELD + 1, HELD + 5):
        pose = world.keyframes[k].world_from_camera
        pose[:3, 3] = centre + factor * (pose[:3, 3] - centre)
    for p, point in world.points.items():
        if p not in old:
            point.position = centre + factor * (point.position - centre)
    for k, keyframe in world.keyframes.items():
        keyframe.depth_units = 1.0
        if k > HELD:  # laid on its own points
            keyframe.depths, keyframe.depth_units = keyframe.depths * factor, factor
    return world


def window_of(world: GlobalMap) -> Window:
    window = choose_window(world, HELD + 4, CONFIG)
    assert (window.free, window.held) == ([5, 6, 7, 8], [HELD])
    return window


def mapper_of(world: GlobalMap, use_depth: bool = True, **options: int) -> Mapper:
    mapper = Mapper(replace(OFTEN, **options), use_depth)
    mapper.world = world
    return mapper


def poses_of(mapper: Mapper) -> dict[int, Array]:
    return {k: keyframe.world_from_camera for k, keyframe in mapper.world.keyframes.items()}


def driven(poses: dict[int, Array]) -> float:
    """How far the camera drove on new ground, over how far it did."""
    return float(np.linalg.norm(poses[8][:3, 3] - poses[5][:3, 3]) / np.linalg.norm([0.3, 0.06, 0.15]))


@pytest.mark.parametrize("factor", [0.1, 0.4, 1.0, 3.0])
def test_new_ground_behind_a_quick_turn_gets_the_metres_of_the_map(factor: float) -> None:
    """Each image's depth has been laid on points that are all of the wrong size: as such it agrees."""
    mapper = mapper_of(turned(factor))
    mapper.optimise(HELD + 4, 0.0)
    assert driven(poses_of(mapper)) == pytest.approx(1.0, abs=0.02)


def test_of_a_map_in_another_unit_too() -> None:
    """A metre is two of its units."""
    mapper = mapper_of(turned(0.4))
    mapper.optimise(HELD + 4, -np.log(2.0))
    assert driven(poses_of(mapper)) == pytest.approx(2.0, abs=0.04)


def test_where_nobody_says_how_large_it_is_it_stays_as_it_was() -> None:
    without, few = turned(0.4), turned(0.4)
    for k in range(HELD + 1, HELD + 5):  # a few depths may all be wrong
        depths, observed = few.keyframes[k].depths, list(few.keyframes[k].observed.values())
        depths[observed[LEAST_SAID // 5 :]] = 0.0
    for mapper in (mapper_of(without, use_depth=False), mapper_of(few)):
        mapper.optimise(HELD + 4, 0.0)
        assert driven(poses_of(mapper)) == pytest.approx(0.4, abs=0.01)


def test_points_beyond_those_that_a_window_wants_grow_as_well() -> None:
    """Left out they would stay where they were, a tenth as far as all about them."""
    mapper, right = mapper_of(turned(0.1), observations=20), turned(1.0)
    mapper.optimise(HELD + 4, 0.0)
    seen = [p for p in right.points if right.points[p].keyframes >= {7, 8}]
    assert len(seen) > 40
    off = [mapper.world.points[p].position - right.points[p].position for p in seen]
    assert np.linalg.norm(off, axis=1).max() < 0.3


def test_a_few_points_do_not_say_it_however_often_they_are_seen() -> None:
    world = turned(1.0)
    often = [p for p, point in world.points.items() if point.keyframes >= {6, 7, 8}][:5]
    for k in range(HELD + 1, HELD + 5):
        keyframe = world.keyframes[k]
        shown = [keyframe.observed[p] for p in often if p in keyframe.observed]
        wrong = np.zeros(len(keyframe.pixels))
        wrong[shown] = 3.0 * keyframe.depths[shown]
        keyframe.depths = wrong
    mapper = mapper_of(world)
    mapper.optimise(HELD + 4, 0.0)
    assert driven(poses_of(mapper)) == pytest.approx(1.0, abs=0.02)


def test_depths_whose_metres_nobody_knows_say_nothing_of_it() -> None:
    """Another network's, laid on the wrong points, would agree with them."""
    world = turned(0.4)
    for keyframe in world.keyframes.values():
        keyframe.depth_units = 0.0
    solution = solve(world, window_of(world), OFTEN, 1.0, use_depth=True)
    assert solution is not None
    assert solution.unit_is_free


def test_a_window_that_may_hold_one_pose_alone_hangs_on_no_one() -> None:
    world, _ = world_of([pose_at(0.2 * i) for i in range(9)])
    one = replace(CONFIG, window=4, fixed=1)
    assert not choose_window(world, 8, one).reaches_out
    mapper = mapper_of(world, window=4, fixed=1)
    before = world.keyframes[8].world_from_camera[0, 3] - world.keyframes[7].world_from_camera[0, 3]
    mapper.optimise(8, -np.log(1.3))
    after = world.keyframes[8].world_from_camera[0, 3] - world.keyframes[7].world_from_camera[0, 3]
    assert after == pytest.approx(before, rel=0.02)


def test_a_second_start_has_the_map_s_metres_too(monkeypatch: pytest.MonkeyPatch) -> None:
    """Not those that its images were laid by, on points of the wrong size."""
    starts: list[bool] = []
    world = turned(0.1)

    def noted(*known: object, as_laid: bool) -> dict[int, np.ndarray]:
        starts.append(as_laid)
        return {k: np.zeros(len(keyframe.pixels)) for k, keyframe in world.keyframes.items()}

    monkeypatch.setattr(module, "STRUGGLED", 0)
    monkeypatch.setattr(module, "of_network", noted)
    world = turned(0.1)
    solve(world, window_of(world), OFTEN, 1.0, use_depth=True)
    solve(world, replace(window_of(world), reaches_out=False), OFTEN, 1.0, use_depth=True)
    assert starts == [False, True]
    window = window_of(world)
    monkeypatch.undo()
    known, members = (window.held, window.free, window.points, set()), [*window.held, *window.free]
    depths = of_network(world, members, 1.0, as_laid=False), of_network(world, members, 1.0)
    found = [second_start(world, *known, laid) for laid in depths]
    assert [driven(poses) for poses, _ in found] == pytest.approx([1.0, 0.1], rel=0.1)


def test_a_map_that_begins_has_its_own_unit_whatever_the_metres_are() -> None:
    """Its keyframes are all that there is: nothing lies behind."""
    world = turned(1.0)
    for k in range(HELD):
        for p in list(world.keyframes[k].observed):
            world.drop_observation(k, p)
        del world.keyframes[k]
    window = choose_window(world, HELD + 4, CONFIG)
    assert (window.held, window.reaches_out) == ([HELD], False)
    mapper = mapper_of(world)
    mapper.optimise(HELD + 4, -np.log(2.0))
    assert driven(poses_of(mapper)) == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize("count", [LEAST_SAID - 1, LEAST_SAID])
def test_enough_points_that_the_map_behind_places_hold_it(count: int) -> None:
    """From far aside, where those in the window could not."""
    world = turned(1.0)
    window = window_of(world)
    shared = [p for p in window.points if HELD in world.points[p].keyframes][:count]
    aside = world.keyframes[0]
    aside.world_from_camera = pose_at(-40.0)
    for p in shared:
        world.observe(0, p, 0)
        world.points[p].parallax_deg = 80.0
    held = placed_elsewhere(world, window)
    assert held == (set(shared) if count == LEAST_SAID else set())
    solution = solve(world, window, OFTEN, 1.0, use_depth=False)
    assert solution is not None
    assert solution.unit_is_free == (not held)
