"""What a loop makes of the local map: points that become one, and keyframes that see them."""

from __future__ import annotations

import numpy as np
import pytest

from prism_edge.geometry.poses import transform
from prism_edge.messages import HOME, MapUpdate
from prism_edge.tracking.frame_tracking import TrackedFrame
from prism_edge.tracking.map_correction import (
    _renamed,
    join,
    take_over,
)
from prism_edge.tracking.submaps import Parts
from tests.synthetic.messages import map_update
from tests.tracking.cloud import BY_POINTS, Cloud, check, pose_at
from tests.tracking.test_map_correction import POSES


def loop_update(**arrays) -> MapUpdate:
    return map_update(5, **{name: np.array(values, np.int64) for name, values in arrays.items()})


def test_a_loop_makes_points_one_the_way_it_says():
    """The backend goes on speaking of the point that it kept, however often either was seen."""
    cloud = Cloud(400, seed=0)
    world, _ = cloud.mapped(POSES)
    ids = world.points.ids
    often = ids[np.argsort(-world.points.observations)[0]]
    alone = world.keyframes[5]
    rarely = int(alone.points[alone.observed()[0]])
    became = join(world, loop_update(fused_from=[often, 10**6], fused_into=[rarely, 10**6 + 1]))
    assert became[often] == rarely
    assert world.points.known(np.array([often, rarely])).tolist() == [False, True]
    assert all(often not in keyframe.points for keyframe in world.keyframes.values())
    check(world)


@pytest.mark.parametrize("pairs", [[(0, 2), (1, 2)], [(0, 1), (1, 2)]], ids=["two become one", "a chain"])
def test_several_points_that_a_loop_makes_one_all_become_it(pairs):
    """The backend has nothing but the last: what stayed here would be seen by nobody else."""
    world, _ = Cloud(400, seed=0).mapped(POSES)
    often = np.argsort(-world.points.observations, kind="stable")[:3]
    ids, seen = world.points.ids[often].copy(), world.points.observations[often].copy()
    views = sum(bool(np.isin(ids, keyframe.points).any()) for keyframe in world.keyframes.values())
    assert views < seen.sum(), "some keyframes see more than one of them"
    old, kept = np.array(pairs).T
    became = join(world, loop_update(fused_from=ids[old], fused_into=ids[kept]))
    assert became == {ids[0]: ids[2], ids[1]: ids[2]}
    assert world.points.known(ids).tolist() == [False, False, True]
    assert world.points.observations[often[2]] == views
    check(world)


def test_a_loop_lets_keyframes_see_points_where_they_can():
    cloud = Cloud(400, seed=0)
    world, _ = cloud.mapped(POSES)
    keyframe = world.keyframes[0]
    keypoint = int(keyframe.observed()[3])
    point = int(keyframe.points[keypoint])
    keyframe.points[keypoint] = -1
    world.points.observations[world.points.rows(np.array([point]))] -= 1
    taken = int(keyframe.observed()[0])
    join(
        world,
        loop_update(
            # as it should be; a keypoint that has a point; an unknown keyframe, point and keypoint
            added_keyframes=[0, 0, 99, 0, 0],
            added_points=[point, point, point, 10**6, int(keyframe.points[taken])],
            added_keypoints=[keypoint, taken, keypoint, keypoint, 10**5],
        ),
    )
    assert keyframe.points[keypoint] == point
    check(world)


def test_a_seed_that_came_first_becomes_what_the_loop_shows_there():
    """Depth is taken in between a loop's closing and its update."""
    world, _ = Cloud(400).mapped([pose_at(), pose_at(0.1), pose_at(0.2)])
    keyframe, table = world.keyframes[2], world.points
    taken, shared = keyframe.observed()[:2].tolist()
    looped, apart = int(keyframe.points[taken]), int(keyframe.points[shared])
    world.drop_observations(np.array([2]), np.array([looped]))
    (seed,) = world.add_points(keyframe, np.array([taken]), np.zeros((1, 3)), np.array([0.2]), 0.0).tolist()
    before = table.observations[table.rows(np.array([looped]))].tolist()
    added = {"added_keyframes": [2, 2], "added_points": [looped, seed], "added_keypoints": [taken, shared]}
    assert join(world, loop_update(**added)) == {seed: looped}
    assert keyframe.points[taken] == looped
    assert keyframe.points[shared] == apart, "two points of one keyframe are two"
    assert table.observations[table.rows(np.array([looped]))].tolist() == [before[0] + 1]
    assert not table.known(np.array([seed])).any()
    assert world.changes.fused == [(seed, looped)], "the backend hears of it"
    check(world)


def test_two_seeds_that_a_keyframe_tells_apart_do_not_both_become_the_loop_s_point():
    world, _ = Cloud(400).mapped([pose_at(i / 10) for i in range(5)])
    looped, first, second = world.keyframes[3].points[world.keyframes[3].observed()[:3]].tolist()
    keypoints = {}
    for k, keyframe in world.keyframes.items():
        keypoints[k] = {p: int(np.flatnonzero(keyframe.points == p)[0]) for p in (looped, first, second)}
    unseen = {looped: (1, 2, 3), first: (0, 2, 4), second: (0, 1, 4)}
    for point, where in unseen.items():
        world.drop_observations(np.array(where), np.array([point] * 3))
    update = loop_update(
        added_keyframes=[1, 2], added_points=[looped, looped],
        added_keypoints=[keypoints[1][first], keypoints[2][second]],
    )
    assert join(world, update) == {first: looped}
    assert world.keyframes[3].points[keypoints[3][first]] == looped
    assert world.keyframes[3].points[keypoints[3][second]] == second
    check(world)


def test_a_loop_s_point_that_the_tracker_does_not_know_changes_nothing():
    world, _ = Cloud(400).mapped([pose_at(), pose_at(0.1)])
    keyframe = world.keyframes[1]
    before = keyframe.points.copy()
    keypoint = int(keyframe.observed()[0])
    update = loop_update(added_keyframes=[1], added_points=[10**9], added_keypoints=[keypoint])
    assert join(world, update) == {}
    assert (keyframe.points == before).all()
    check(world)


def test_the_last_frame_sees_a_point_once_though_it_matched_both_that_are_one():
    assert _renamed(np.array([3, -1, 5, -1, 7]), {5: 3}).tolist() == [3, -1, -1, -1, 7]


def test_the_last_frame_knows_a_point_by_the_name_that_a_loop_gave_it():
    """The next frame is tracked by its points: under the old name they would be lost."""
    world, _ = Cloud(400, seed=0).mapped(POSES)
    view, table = world.keyframes[5], world.points
    old = view.points[view.observed()[:20]].copy()
    kept = table.ids[~np.isin(table.ids, view.points)][:20].copy()
    last = TrackedFrame.of_keyframe(view, len(view.observed()))
    before, at = last.points.copy(), np.isin(last.points, old)
    take_over(world, Parts(), loop_update(fused_from=old, fused_into=kept), last, BY_POINTS)
    became = dict(zip(old.tolist(), kept.tolist(), strict=True))
    assert last.points[at].tolist() == [became[point] for point in before[at].tolist()]
    assert table.known(last.points[last.points >= 0]).all()


def test_what_a_loop_makes_one_goes_on_to_the_point_that_takes_its_keypoint():
    world, _ = Cloud(400).mapped([pose_at(), pose_at(0.1)])
    keyframe = world.keyframes[1]
    looped, mine, other = keyframe.points[keyframe.observed()[:3]].tolist()
    keypoint = int(np.flatnonzero(keyframe.points == mine)[0])
    for point, k in ((looped, 1), (other, 0), (other, 1), (mine, 0)):
        here = world.keyframes[k]
        here.points[here.points == point] = -1
        world.points.observations[world.points.rows(np.array([point]))] -= 1
    update = loop_update(
        fused_from=[other], fused_into=[mine],
        added_keyframes=[1], added_points=[looped], added_keypoints=[keypoint],
    )
    assert join(world, update) == {other: looped, mine: looped}
    assert keyframe.points[keypoint] == looped
    check(world)


def test_a_loop_lets_no_keyframe_see_a_point_twice():
    world, _ = Cloud(400, seed=0).mapped(POSES)
    keyframe = world.keyframes[0]
    seen, free = keyframe.observed()[[3, 5]].tolist()
    world.drop_observations(np.array([0]), keyframe.points[[free]].copy())
    assert keyframe.points[free] == -1
    point = int(keyframe.points[seen])
    join(world, loop_update(added_keyframes=[0], added_points=[point], added_keypoints=[free]))
    assert keyframe.points[free] == -1
    check(world)


def test_after_a_loop_points_are_as_seen_from_where_the_keyframes_are_now():
    """What is looked for, and at which size, goes by that."""
    world, _ = Cloud(400, seed=0).mapped(POSES)
    table, ids = world.points, world.points.ids.copy()
    turn = pose_at(0.0, 0.0, 0.0, 0.0, 1.5)
    update = map_update(
        5, keyframes=np.arange(6), poses=np.array([turn @ pose for pose in POSES]), points=ids,
        positions=transform(turn, table.position), parallax_deg=np.zeros(len(ids), np.float32),
        loop_query=5, loop_candidate=0,
    )  # fmt: skip
    take_over(world, Parts(), update, None, BY_POINTS)
    newest = world.keyframes[5]
    rows = table.rows(newest.points[newest.observed()])
    offset = newest.world_from_camera[:3, 3] - table.position[rows]
    assert table.distance[rows] == pytest.approx(np.linalg.norm(offset, axis=1))
    assert table.direction[rows] == pytest.approx(offset / np.linalg.norm(offset, axis=1)[:, None])


@pytest.mark.parametrize(
    ("older", "said"),
    [(HOME, "has its place in the map"), (1, "is joined to another, whose place isn't known")],
)
def test_only_a_part_that_is_joined_to_what_has_a_place_is_said_to_have_one(
    older: int, said: str, caplog: pytest.LogCaptureFixture
) -> None:
    world, _ = Cloud(400, seed=0).mapped(POSES)
    parts = Parts.given({4: 4, 5: 4} | ({1: 1, 2: 1} if older != HOME else {}))
    with caplog.at_level("INFO", "prism_edge.tracking"):
        take_over(world, parts, map_update(5, loop_query=4, loop_candidate=1), None, BY_POINTS)
    assert parts.of(4) == older
    assert [record.getMessage() for record in caplog.records] == [f"the part of keyframe 4 {said}"]
