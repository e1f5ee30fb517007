"""A map with near and far exchanged, which fits its pixels nearly as well, and what depths make of it."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
import pytest

from prism_edge.backend import window as module
from prism_edge.backend.global_map import GlobalMap
from prism_edge.backend.second_start import (
    FARTHEST,
    LEAST,
    LESS,
    SHARE,
    WITNESSES,
    Start,
    clearly_less,
    is_exchanged,
    mirrored,
    of_network,
    second_start,
)
from prism_edge.backend.window import Solution, choose_window, solve
from prism_edge.config import BackendConfig
from prism_edge.geometry.poses import inverse, se3_log
from tests.backend.test_window import CONFIG, worst
from tests.backend.world import Teller, depth_at_keypoints
from tests.tracking.cloud import pose_at

FAR, DEEP, STEP = 4.0, 0.5, 0.15
NEWEST = 4
ASIDE = [pose_at(STEP * k) for k in range(NEWEST + 1)]
KNOWN_GROUND = replace(CONFIG, fixed=1)  # where one pose that holds a window is as many as may be


def world_of(
    reverse: bool = True, depth_noise: float = 0.05, noise_px: float = 0.5, deep: float = DEEP
) -> tuple[GlobalMap, Teller]:
    """A camera steps aside before a shallow scene; reversed, the map has it the other way."""
    rng = np.random.default_rng(3)
    teller, world = Teller(250, noise_px=noise_px), GlobalMap()
    cloud = teller.cloud
    depth = FAR + rng.uniform(-deep, deep, len(cloud.positions))
    rays = rng.uniform((-0.3, -0.3), (0.4, 0.3), (len(depth), 2))
    cloud.positions = np.column_stack([rays * FAR, depth])
    for pose in ASIDE:
        world.absorb(teller.keyframe(pose))
    depth_at_keypoints(world, cloud, ASIDE)
    for k, keyframe in world.keyframes.items():
        assert keyframe.depths is not None
        keyframe.depths *= np.exp(rng.normal(0.0, depth_noise, len(keyframe.depths)))
        keyframe.depth_units = 1.0
        keyframe.world_from_camera = ASIDE[k].copy()
    for p, point in world.points.items():
        point.position, point.parallax_deg = cloud.positions[p].copy(), 2.0
    if reverse:
        for k, keyframe in world.keyframes.items():
            keyframe.world_from_camera = pose_at(-STEP * k, 0.0, 0.0, 0.0, 2.0 * STEP * k / FAR)
        for point in world.points.values():
            x, y, z = point.position
            point.position = (2.0 * FAR - z) * np.array([x / z, y / z, 1.0])
    return world, teller


def solved(world: GlobalMap, config: BackendConfig) -> Solution:
    solution = solve(world, choose_window(world, NEWEST, config), config, 1.0, True)
    assert solution is not None
    return solution


def from_network(
    world: GlobalMap,
    held: list[int],
    free: list[int],
    points: list[int],
    pinned: set[int],
    units_per_metre: float = 1.0,
) -> Start | None:
    depths = of_network(world, [*held, *free], units_per_metre)
    return second_start(world, held, free, points, pinned, depths)


def test_a_reversed_map_stays_so_by_itself_and_is_left_for_what_depths_begin_with(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO)
    world, teller = world_of()
    assert worst(solved(world, KNOWN_GROUND), teller) > 4 * STEP, "the other way"
    assert not caplog.messages
    assert worst(solved(world, CONFIG), teller) < 0.05
    (line,) = caplog.messages
    assert line.startswith(f"keyframe {NEWEST}: its window fits better as depth has it")


def test_it_comes_to_the_same_whichever_way_the_world_is_turned() -> None:
    """Depths are unsure along the rays of who has them, wherever these point in the map."""
    world, _ = world_of(reverse=False)
    free, points = list(range(1, NEWEST + 1)), sorted(world.points)
    there = from_network(world, [0], free, points, set(), 1.0)
    turn = pose_at(3.0, -1.0, 2.0, 0.0, np.radians(90.0))
    world.move(turn, set(world.keyframes))
    turned = from_network(world, [0], free, points, set(), 1.0)
    assert there is not None
    assert turned is not None
    for k in free:
        assert np.abs(se3_log(inverse(turn @ there[0][k]) @ turned[0][k])).max() < 1e-6


def test_a_map_that_is_right_stays_as_it_is_solved(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    world, _ = world_of(reverse=False)
    with_it, without = solved(world, CONFIG), solved(world, KNOWN_GROUND)
    assert all(np.array_equal(with_it.poses[k], without.poses[k]) for k in without.poses)
    assert not caplog.messages


def test_depths_with_near_and_far_exchanged_do_not_lead_a_right_map_astray() -> None:
    world, teller = world_of(reverse=False)
    for keyframe in world.keyframes.values():
        assert keyframe.depths is not None
        keyframe.depths = 2.0 * FAR - keyframe.depths
    assert worst(solved(world, CONFIG), teller) < 0.06


def test_what_depths_begin_with_is_left_where_it_fits_no_better(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """However long the map's own start took: a network that is wrong throughout must not turn it over."""
    caplog.set_level(logging.INFO)
    monkeypatch.setattr(module, "STRUGGLED", 0)
    world, teller = world_of(reverse=False)
    for keyframe in world.keyframes.values():
        assert keyframe.depths is not None
        keyframe.depths = 2.0 * FAR - keyframe.depths
    assert worst(solved(world, CONFIG), teller) < 0.06
    assert not caplog.messages


def test_where_the_map_s_own_start_is_soon_done_there_is_no_other(monkeypatch: pytest.MonkeyPatch) -> None:
    """It sits where it belongs, and to solve all twice would take the time of all."""
    asked: list[object] = []
    monkeypatch.setattr(module, "second_start", lambda *said: asked.append(said))
    for reverse in (False, True):
        solved(world_of(reverse)[0], CONFIG)
        assert bool(asked) == reverse


def test_without_depth_in_use_there_is_no_other_start() -> None:
    world, teller = world_of()
    solution = solve(world, choose_window(world, NEWEST, CONFIG), CONFIG, 1.0, False)
    assert solution is not None
    assert worst(solution, teller) > 4 * STEP


@pytest.mark.parametrize("units", [1.0, 0.2])
def test_depths_alone_place_keyframes_and_points(units: float) -> None:
    """Each image's depths are in the map's unit as its keyframe had it: all are taken by one."""
    world, teller = world_of(depth_noise=0.0)
    for k, keyframe in world.keyframes.items():
        assert keyframe.depths is not None
        own = units * (1.0 + 0.1 * (k - 2))
        keyframe.depths, keyframe.depth_units = keyframe.depths * own, own
    free, points = list(range(1, NEWEST + 1)), sorted(world.points)
    found = from_network(world, [0], free, points, set(), 1.0)
    assert found is not None
    poses, places = found
    assert list(poses) == free
    for k in free:
        expected = ASIDE[k].copy()
        expected[:3, 3] *= units
        apart = se3_log(inverse(expected) @ poses[k])
        assert np.abs(apart[:3]).max() < 0.02 * units
        assert np.abs(apart[3:]).max() < 0.005
    off = [np.linalg.norm(places[p] / units - teller.cloud.positions[p]) for p in points]
    assert np.median(off) < 0.02


@pytest.mark.parametrize("aligned", [0, NEWEST])
def test_metres_that_do_not_fit_the_map_may_be_right_all_the_same(aligned: int) -> None:
    """A reversed map is what they don't fit; their unit is that of the images that do, or the filter's."""
    world, _ = world_of(depth_noise=0.0)
    for k, keyframe in world.keyframes.items():
        if k >= aligned:
            keyframe.unfitting, keyframe.depths, keyframe.depth_units = keyframe.depths, None, 0.0
        else:
            assert keyframe.depths is not None
            keyframe.depths, keyframe.depth_units = 2.0 * keyframe.depths, 2.0
    free = list(range(1, NEWEST + 1))
    found = from_network(world, [0], free, sorted(world.points), set(), 3.0)
    assert found is not None
    units = 2.0 if aligned else 3.0
    for k in free:
        expected = ASIDE[k].copy()
        expected[:3, 3] *= units
        assert np.abs(se3_log(inverse(expected) @ found[0][k])).max() < 0.02 * units


def test_who_shares_little_with_those_held_waits_for_those_between() -> None:
    """Keyframe 0 sees nothing of what the held one does; the others half of what is beside them."""
    world, teller = world_of(reverse=False, depth_noise=0.0, noise_px=0.0)
    for p in sorted(world.points):
        for k in world.points[p].keyframes - {p % NEWEST, p % NEWEST + 1}:
            world.drop_observation(k, p)
    found = from_network(world, [NEWEST], list(range(NEWEST)), sorted(world.points), set(), 1.0)
    assert found is not None
    assert worst(Solution(found[0], {}, {}, [], 0), teller) < 0.02


def test_what_is_pinned_stays_and_what_no_image_has_depth_for_goes_with_who_saw_it_first() -> None:
    world, _ = world_of(depth_noise=0.0)
    pinned, bare = sorted(world.points)[:2]
    for keyframe in world.keyframes.values():
        assert keyframe.depths is not None
        if bare in keyframe.observed:
            keyframe.depths[keyframe.observed[bare]] = 0.0
    before = {p: world.points[p].position.copy() for p in (pinned, bare)}
    found = from_network(world, [0], list(range(1, NEWEST + 1)), sorted(world.points), {pinned}, 1.0)
    assert found is not None
    poses, places = found
    assert np.array_equal(places[pinned], before[pinned])
    first = min(world.points[bare].keyframes)
    motion = {0: np.eye(4), **poses}[first] @ inverse(world.keyframes[first].world_from_camera)
    assert places[bare] == pytest.approx(motion[:3, :3] @ before[bare] + motion[:3, 3])


def test_a_bare_point_that_only_keyframes_which_move_see_moves_with_them() -> None:
    world, _ = world_of(depth_noise=0.0)
    bare = next(p for p in sorted(world.points) if len(world.points[p].keyframes) == NEWEST + 1)
    for k in (0, 1):
        world.drop_observation(k, bare)
    for keyframe in list(world.keyframes.values())[2:]:
        assert keyframe.depths is not None
        keyframe.depths[keyframe.observed[bare]] = 0.0
    before = world.points[bare].position.copy()
    found = from_network(world, [0], list(range(1, NEWEST + 1)), sorted(world.points), set(), 1.0)
    assert found is not None
    motion = found[0][2] @ inverse(world.keyframes[2].world_from_camera)
    assert found[1][bare] == pytest.approx(motion[:3, :3] @ before + motion[:3, 3])
    assert np.linalg.norm(found[1][bare] - before) > STEP / 3


@pytest.mark.parametrize("with_depth", [0, LEAST - 1, LEAST])
def test_a_keyframe_that_too_few_depths_place_is_placed_by_none(with_depth: int) -> None:
    world, _ = world_of(depth_noise=0.0)
    shared = [p for p in sorted(world.points) if len(world.points[p].keyframes) == NEWEST + 1]
    for keyframe in world.keyframes.values():
        assert keyframe.depths is not None
        kept = [keyframe.observed[p] for p in shared[:with_depth]]
        rest = np.setdiff1d(np.arange(len(keyframe.depths)), kept)
        keyframe.depths[rest] = 0.0
    found = from_network(world, [0], list(range(1, NEWEST + 1)), sorted(world.points), set(), 1.0)
    assert (found is not None) == (with_depth >= LEAST)


@pytest.mark.parametrize("before", [10.0, 100.0, 1000.0])
def test_less_is_by_more_than_a_solver_s_noise(before: float) -> None:
    least = max(LESS, SHARE * before)
    assert clearly_less(before - 1.01 * least, before)
    assert not clearly_less(before - 0.99 * least, before)


def test_a_map_that_has_settled_the_other_way_is_left_for_its_mirror_image(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Depths that know the order of things and little else begin in no valley at all."""
    caplog.set_level(logging.INFO)
    monkeypatch.setattr(module, "STRUGGLED", 1000)
    monkeypatch.setattr(module, "of_network", lambda world, members, *_, **__: nothing(world))
    world, teller = world_of(deep=1.0)
    assert worst(solved(world, CONFIG), teller) < 0.05
    (line,) = caplog.messages
    assert line.startswith(f"keyframe {NEWEST}: its window fits better as its mirror image")
    assert worst(solved(world_of(deep=1.0)[0], KNOWN_GROUND), teller) > 4 * STEP


def nothing(world: GlobalMap) -> dict[int, np.ndarray]:
    return {k: np.zeros(len(keyframe.pixels)) for k, keyframe in world.keyframes.items()}


def test_a_right_map_is_not_left_for_its_mirror_image(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Whatever the network says of near and far: the pixels decide."""
    caplog.set_level(logging.INFO)
    monkeypatch.setattr(module, "is_exchanged", lambda *_: True)
    world, teller = world_of(reverse=False, deep=1.0)
    assert worst(solved(world, CONFIG), teller) < 0.06
    assert not caplog.messages


@pytest.mark.parametrize("reverse", [False, True])
@pytest.mark.parametrize("unfitting", [False, True])
def test_the_network_tells_which_way_round_a_map_is(reverse: bool, unfitting: bool) -> None:
    world, _ = world_of(reverse, depth_noise=0.1, deep=1.0)
    poses = {k: keyframe.world_from_camera for k, keyframe in world.keyframes.items()}
    places = {p: point.position for p, point in world.points.items()}
    if unfitting:
        for keyframe in world.keyframes.values():
            keyframe.unfitting, keyframe.depths, keyframe.depth_units = keyframe.depths, None, 0.0
    assert is_exchanged(world, poses, places) == reverse
    few = dict(list(poses.items())[: WITNESSES - 1])
    assert not is_exchanged(world, few, places), "too few witnesses"
    for point in world.points.values():
        point.parallax_deg = 0.5
    assert not is_exchanged(world, poses, places), "seeds lie where the network has them"


def test_inverse_depths_are_mirrored_at_their_median() -> None:
    world, teller = world_of(reverse=False, noise_px=0.0)
    keyframe = world.keyframes[2]
    points = sorted(keyframe.observed)[:-1]
    left = max(keyframe.observed)
    depths = mirrored(world, [2], points)[2]
    assert depths[keyframe.observed[left]] == 0.0
    keypoints = [keyframe.observed[p] for p in points]
    true = teller.cloud.positions[points, 2]
    middle = np.median(1.0 / true)
    assert 1.0 / depths[keypoints] == pytest.approx(2.0 * middle - 1.0 / true)
    # What is nearer than half of the middle has its mirror image beyond infinity.
    world.points[points[0]].position = 0.1 * world.points[points[0]].position + 0.9 * ASIDE[2][:3, 3]
    world.points[points[1]].position = np.array([0.0, 0.0, -1.0])
    depths = mirrored(world, [2], points)[2]
    assert depths[keypoints[0]] == pytest.approx(FARTHEST * np.median(true), rel=0.01)
    assert depths[keypoints[1]] == 0.0, "behind the camera"
