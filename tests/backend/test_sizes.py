"""How large places are beside each other: two rooms through a door, and what each keyframe may say of it."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import L, X

from prism_edge.backend.global_adjustment import GlobalAdjustment, apply
from prism_edge.backend.global_map import GlobalKeyframe, GlobalMap, GlobalPoint
from prism_edge.backend.sizes import BESIDE, CARRIERS, SHARE, Size, size_factors, sizes
from prism_edge.config import BackendConfig
from prism_edge.geometry.poses import Array, inverse, transform
from tests.tracking.cloud import CAMERA, pose_at

CONFIG = BackendConfig()
EACH = 6  # keyframes of a room
SECOND = range(EACH, 2 * EACH)


def two_rooms(stretch: float = 1.0, seed: int = 0) -> GlobalMap:
    """Two rooms of the same kind, 8 m from each other, and a few points far behind a door that both see.

    All of the second is ``stretch`` times as far from its first keyframe as it is. Each keyframe has a
    network's depth of all that it sees, 8 % off for each point and 3 % for each keyframe. The unit is 1 m.
    """
    rng, world = np.random.default_rng(seed), GlobalMap()
    boxes = [rng.uniform((x - 2.0, -1.5, 3.0), (x + 2.0, 1.5, 6.0), (80, 3)) for x in (0.0, 8.0)]
    door = rng.uniform((2.0, -2.0, 40.0), (6.0, 2.0, 50.0), (12, 3))
    places = np.concatenate([*boxes, door])
    for k in range(2 * EACH):
        pose = pose_at(0.2 * k if k < EACH else 7.0 + 0.2 * k)
        local = transform(inverse(pose), places)
        pixels = CAMERA.project(local) + rng.normal(0.0, 0.3, (len(places), 2))
        keyframe = GlobalKeyframe(k, k, CAMERA, pose, pixels, np.ones(len(places)), {})
        noise = np.exp(rng.normal(0.0, 0.08, len(places)) + rng.normal(0.0, 0.03))
        keyframe.depths, keyframe.depth_units = local[:, 2] * noise, 1.0
        world.keyframes[k] = keyframe
        own = range(80) if k < EACH else range(80, 160)
        through = range(160, 172) if EACH - 2 <= k < EACH + 2 else range(0)
        for p in (*own, *through):
            world.points.setdefault(p, GlobalPoint(places[p].copy(), parallax_deg=5.0 if p < 160 else 0.2))
            world.observe(k, p, p)
    centre = world.keyframes[EACH].world_from_camera[:3, 3].copy()
    for k in SECOND:
        pose = world.keyframes[k].world_from_camera
        pose[:3, 3] = centre + stretch * (pose[:3, 3] - centre)
    for p in range(80, 160):
        world.points[p].position = centre + stretch * (world.points[p].position - centre)
    return world


def everything(world: GlobalMap) -> dict[int, list[int]]:
    return {k: list(keyframe.observed) for k, keyframe in world.keyframes.items()}


def way(world: GlobalMap, room: range) -> float:
    ends = [world.keyframes[k].world_from_camera[:3, 3] for k in (room[0], room[-1])]
    return float(np.linalg.norm(ends[1] - ends[0]))


def adjusted(world: GlobalMap, use_depth: bool = True) -> GlobalMap:
    job = GlobalAdjustment(world, CONFIG, 1.0, use_depth, parts=[set(world.keyframes)])
    while not job.step():
        pass
    result = job.result()
    assert result is not None
    apply(world, result, CONFIG)
    return world


def of_second_to_first(world: GlobalMap) -> float:
    return way(world, SECOND) / way(world, range(EACH))


@pytest.mark.parametrize("stretch", [0.8, 1.25])
def test_two_rooms_come_to_one_size_which_reprojection_does_not_see(stretch: float) -> None:
    alone = of_second_to_first(adjusted(two_rooms(stretch), use_depth=False))
    assert abs(np.log(alone)) > 0.5 * abs(np.log(stretch))
    assert of_second_to_first(adjusted(two_rooms(stretch))) == pytest.approx(1.0, abs=0.04)


def test_what_is_of_one_size_stays_of_it() -> None:
    assert of_second_to_first(adjusted(two_rooms())) == pytest.approx(1.0, abs=0.04)


def test_a_network_that_flattens_what_it_sees_does_not_bend_the_map() -> None:
    """Far things are said to be nearer in every image alike: nothing is asked for that is not there."""
    world = two_rooms()
    for k, keyframe in world.keyframes.items():
        assert keyframe.depths is not None
        seen = list(keyframe.observed.values())
        depth = transform(inverse(keyframe.world_from_camera), [world.points[p].position for p in seen])[:, 2]
        keyframe.depths[seen] = 2.0 * 4.5 * (depth / 4.5) ** 0.7
        assert sizes(world, [k], everything(world))[0].log_units == pytest.approx(-np.log(2.0), abs=0.05)
    before = ranges(world)
    grown = np.log(ranges(adjusted(world)) / before)
    near, far = before < np.quantile(before, 0.3), before > np.quantile(before, 0.7)
    assert np.median(grown[near]) == pytest.approx(np.median(grown[far]), abs=0.01)


def ranges(world: GlobalMap) -> Array:
    """How far each room's points are from its first keyframe (160,)."""
    places = np.array([world.points[p].position for p in range(160)])
    centres = [world.keyframes[k].world_from_camera[:3, 3] for k in (0, EACH)]
    return np.linalg.norm(places - np.repeat(centres, 80, axis=0), axis=1)


def error_of(size: Size, scaled: float) -> float:
    """What its factors cost beside four of size 1, its points ``scaled`` times as far as they are."""
    rest = [Size(k, 0.0, 0.1, {}) for k in range(1, 5)]
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for factor in size_factors([size, *rest]):
        graph.add(factor)
    values.insert(X(size.keyframe), gtsam.Pose3())
    for p, distance in size.ranges.items():
        values.insert(L(p), scaled * distance * np.array([0.0, 0.6, 0.8]))
    return float(graph.error(values))


@pytest.mark.parametrize("off", [-0.1, 0.02, 0.1])
@pytest.mark.parametrize("points", [1, 7, CARRIERS])
def test_a_keyframe_s_points_weigh_together_as_its_sigma_and_ask_for_the_size_of_the_others(
    off: float, points: int
) -> None:
    sigma = 0.2
    size = Size(0, off, sigma, {p: 2.0 + 0.3 * p for p in range(points)})
    assert error_of(size, 1.0) == pytest.approx(0.5 * (off / sigma) ** 2, rel=0.01)
    assert error_of(size, float(np.exp(-off))) == pytest.approx(0.0, abs=1e-12)


def test_a_part_in_a_unit_of_its_own_keeps_it() -> None:
    far = [Size(k, 0.7, 0.1, {k: 2.0 + k}) for k in range(5)]
    asked = [factor.measured() for factor in size_factors(far)]
    assert asked == pytest.approx([2.0 + k for k in range(5)])


def heard(said: list[float]) -> list[bool]:
    """Which keyframes of a part ask for anything."""
    found = [Size(k, log_units, 0.1, {k: 2.0}) for k, log_units in enumerate(said)]
    keys = {factor.keys()[0] for factor in size_factors(found)}
    return [X(k) in keys for k in range(len(said))]


def test_an_image_that_says_otherwise_than_those_about_it_is_not_heard_and_a_place_is() -> None:
    rng = np.random.default_rng(0)
    rooms = np.r_[np.zeros(20), np.full(20, 0.3), np.full(BESIDE + 1, -0.2)] + rng.normal(0.0, 0.02, 44)
    assert all(heard(rooms.tolist()))
    odd = rooms.copy()
    odd[[5, 25]] = -0.4, 0.9
    assert [k for k, good in enumerate(heard(odd.tolist())) if not good] == [5, 25]
    assert heard([0.0] * 9 + [1.0] * 8) == [True] * 9 + [False] * 8  # nothing is twice as large


@pytest.mark.parametrize("factor", [0.1, 1.0 / 3.0, 0.5, 2.0, 10.0])
def test_an_image_whose_metres_are_wrong_bends_nothing(factor: float) -> None:
    world = two_rooms()
    depths = world.keyframes[8].depths
    assert depths is not None
    world.keyframes[8].depths = factor * depths
    as_ever = of_second_to_first(adjusted(two_rooms()))
    assert of_second_to_first(adjusted(world)) == pytest.approx(as_ever, abs=0.01)


def test_each_part_is_drawn_to_its_own_size() -> None:
    """Nothing but a loop tells what the unit of one is in the other's."""
    world = two_rooms()
    for k in SECOND:
        world.keyframes[k].depth_units = 1.6
    for p in range(160, 172):
        for k in sorted(world.points.pop(p).keyframes):
            del world.keyframes[k].observed[p]
    before = way(world, SECOND)
    job = GlobalAdjustment(world, CONFIG, 1.0, True, parts=[set(range(EACH)), set(SECOND)])
    while not job.step():
        pass
    result = job.result()
    assert result is not None
    apply(world, result, CONFIG)
    assert way(world, SECOND) == pytest.approx(before, rel=0.05)


def changed(**changes: object) -> list[Size]:
    world = two_rooms()
    for name, value in changes.items():
        setattr(world.keyframes[0], name, value)
    with np.errstate(all="raise"):
        return sizes(world, [0], everything(world))


def test_a_keyframe_says_what_a_metre_is_there_and_how_sure_it_is() -> None:
    (size,) = changed()
    assert size.log_units == pytest.approx(0.0, abs=0.1)  # 3 % of the keyframe, 8 % of each of its points
    assert 0.04 < size.sigma / SHARE < 0.11
    assert len(size.ranges) == CARRIERS
    all_ranges = np.linalg.norm([point.position for p, point in two_rooms().points.items() if p < 80], axis=1)
    least, most = np.quantile(all_ranges, (0.25, 0.75))
    carried = sorted(size.ranges.values())
    assert least - 0.1 < carried[0] < least + 0.3
    assert most - 0.3 < carried[-1] < most + 0.1
    doubled = two_rooms().keyframes[0].depths
    assert doubled is not None
    assert changed(depths=2.0 * doubled, depth_units=2.0)[0] == size
    assert changed(depths=2.0 * doubled)[0].log_units == pytest.approx(size.log_units - np.log(2.0))


def constant() -> Array:
    """What a network says that is at a loss before a street."""
    return np.full(172, 2.0)


def test_a_keyframe_of_which_nothing_is_known_says_nothing() -> None:
    assert changed(depths=None) == changed(depth_units=0.0) == changed(observed={}) == []
    assert changed(depths=np.zeros(172)) == []
    behind = pose_at(0.0)
    behind[2, 3] = 100.0
    assert changed(world_from_camera=behind) == []
    world = two_rooms()
    assert sizes(world, [0], {0: range(19)}) == []
    for p in range(80):
        world.points[p].parallax_deg = 0.5
    assert sizes(world, [0], everything(world)) == []
    assert len(sizes(world, [0], everything(world), any_at_all=True)) == 1
    far = two_rooms()  # a scene of several depths, of which the network knows none
    for p in range(40):
        far.points[p].position = far.points[p].position * 5.0
    far.keyframes[0].depths = constant()
    assert sizes(far, [0], everything(far)) == []
    (vague,) = sizes(far, [0], everything(far), any_at_all=True)
    assert vague.sigma > 1.0
    assert size_factors([]) == []


def test_no_part_s_size_creeps_however_often_all_is_adjusted() -> None:
    """Where a network says in a third of a part that it is larger there, the mean is not the median."""
    world = two_rooms()
    for p in range(160, 172):
        for k in sorted(world.points.pop(p).keyframes):
            del world.keyframes[k].observed[p]
    del world.keyframes[2 * EACH - 1], world.keyframes[2 * EACH - 2]  # the first room is the majority
    for point in world.points.values():
        point.keyframes = {k for k in point.keyframes if k in world.keyframes}
    second = range(EACH, 2 * EACH - 2)
    for k in (EACH + 1, EACH + 2):
        depths = world.keyframes[k].depths
        assert depths is not None
        world.keyframes[k].depths = depths * np.exp(-0.14)
    before = [way(world, room) for room in (range(EACH), second)]
    for _ in range(8):
        job = GlobalAdjustment(world, CONFIG, 1.0, True, parts=[set(range(EACH)), set(second)])
        while not job.step():
            pass
        result = job.result()
        assert result is not None
        apply(world, result, CONFIG)
    for room, was in zip((range(EACH), second), before, strict=True):
        assert way(world, room) == pytest.approx(was, rel=0.03)


@pytest.mark.parametrize("away", [3.0, 0.1])
def test_a_part_that_ran_off_stays_as_it_was_and_costs_the_rest_nothing(monkeypatch, away: float) -> None:
    """What people before the lens give a robot has two keyframes, and nothing that says how large it is."""
    world, second = two_rooms(), set(SECOND)
    for p in range(160, 172):
        for k in sorted(world.points.pop(p).keyframes):
            del world.keyframes[k].observed[p]
    for keyframe in world.keyframes.values():
        keyframe.world_from_camera = keyframe.world_from_camera @ pose_at(0.003 * keyframe.id)
    true_change = GlobalAdjustment._unit_change

    def change(job: GlobalAdjustment, part: set[int], *solved: dict[int, Array]) -> float:
        return away if part == second else true_change(job, part, *solved)

    monkeypatch.setattr(GlobalAdjustment, "_unit_change", change)
    job = GlobalAdjustment(world, CONFIG, 1.0, True, parts=[set(range(EACH)), second])
    while not job.step():
        pass
    result = job.result()
    assert result is not None
    for k, keyframe in world.keyframes.items():
        same = np.allclose(result.poses[k], keyframe.world_from_camera, atol=1e-12)
        assert same == (k in second or k == 0), k
    for p, place in result.points.items():
        assert np.allclose(place, world.points[p].position, atol=1e-12) == (p >= 80), p
    monkeypatch.setattr(GlobalAdjustment, "_unit_change", lambda *_: away)
    assert job.result() is None, "home itself"
