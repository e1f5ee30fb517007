"""What a new keyframe gives the map, on a cloud of points whose places are known."""

from __future__ import annotations

import numpy as np
import pytest

from prism_edge.geometry.poses import transform
from prism_edge.tracking import mapping
from prism_edge.tracking.features import Features
from prism_edge.tracking.local_map import LocalKeyframe, LocalMap
from tests.tracking.cloud import CAMERA, FACTORS, Cloud, check, pose_at


def seeded(cloud: Cloud, every: int = 10, wrong: float = 1.0) -> tuple[LocalMap, np.ndarray]:
    """One keyframe with points seeded at each tenth keypoint, ``wrong`` times as far as they are."""
    world = LocalMap()
    keyframe, shown = cloud.keyframe(0, np.eye(4), noise_px=0.3)
    world.add_keyframe(keyframe)
    chosen = np.arange(0, len(shown), every)
    positions = cloud.positions[shown[chosen]] * wrong
    world.add_points(keyframe, chosen, positions, np.full(len(chosen), 0.2), 0.0)
    return world, shown


def add(world, cloud, shown, number, pose, noise_px=0.3):
    """A further keyframe, which observes those points of the first that it sees."""
    first = world.keyframes[0]
    keyframe, seen = cloud.keyframe(number, pose, noise_px)
    at_first = dict(zip(shown.tolist(), first.points.tolist(), strict=True))
    keyframe.points = np.array([at_first.get(p, -1) for p in seen.tolist()], np.int64)
    world.add_keyframe(keyframe)
    return keyframe, seen


def test_new_points_are_where_the_corners_are():
    cloud = Cloud(500, seed=0)
    world, shown = seeded(cloud)
    keyframe, seen = add(world, cloud, shown, 1, pose_at(0.4))
    created = sum(mapping.triangulating(world, keyframe, [world.keyframes[0]], FACTORS))
    assert created > 250
    check(world)
    new = world.points.rows(np.concatenate(world.changes.new_points[1:]))
    assert len(new) == created
    at = {int(p): i for i, p in enumerate(keyframe.points)}
    true = cloud.positions[seen[[at[int(p)] for p in world.points.ids[new]]]]
    error = np.linalg.norm(world.points.position[new] - true, axis=1)
    depth = true[:, 2]
    # The claimed relative error along the ray is honest: neither much too small nor much too large.
    relative = error / depth / world.points.log_depth_sigma[new]
    assert 0.1 < np.median(relative) < 1.0
    assert np.quantile(relative, 0.95) < 2.5
    to_now = true - (0.4, 0.0, 0.0)
    cosine = (true * to_now).sum(1) / np.linalg.norm(true, axis=1) / np.linalg.norm(to_now, axis=1)
    assert np.median(np.abs(world.points.parallax_deg[new] - np.degrees(np.arccos(cosine)))) < 0.1
    # Both keyframes see each, and those of the earlier one are told as late.
    assert (world.points.observations[new] == 2).all()
    assert {(p, k) for p, k, _ in world.changes.late} == {(int(p), 0) for p in world.points.ids[new]}


def share(world: LocalMap, source: LocalKeyframe, target: LocalKeyframe) -> tuple[np.ndarray, np.ndarray]:
    """Let one keyframe observe another's points; returns the doubles."""
    return mapping.share_points(world, mapping.shareable(world, [source]), target, FACTORS)


@pytest.mark.parametrize(
    ("pose", "reason"), [(pose_at(0.01), "baseline"), (pose_at(0, 0, 0, 0, 0.1), "pure rotation")]
)
def test_nothing_is_triangulated_without_parallax(pose, reason):
    cloud = Cloud(500, seed=0)
    world, shown = seeded(cloud)
    keyframe, _ = add(world, cloud, shown, 1, pose)
    assert not list(mapping.triangulating(world, keyframe, [world.keyframes[0]], FACTORS)), reason


def test_only_what_has_parallax_is_triangulated():
    cloud = Cloud(500, seed=0)
    world, shown = seeded(cloud)
    keyframe, _ = add(world, cloud, shown, 1, pose_at(0.08), noise_px=0.1)
    list(mapping.triangulating(world, keyframe, [world.keyframes[0]], FACTORS))
    new = world.points.rows(np.concatenate(world.changes.new_points[1:]))
    assert len(new) > 50
    assert world.points.parallax_deg[new].min() >= 1.0
    assert np.quantile(world.points.position[new, 2], 0.95) < 0.08 / np.radians(1.0) * 1.1


def test_wrong_poses_triangulate_next_to_nothing():
    cloud = Cloud(500, seed=0)
    world, shown = seeded(cloud)
    keyframe, _ = add(world, cloud, shown, 1, pose_at(0.4))
    keyframe.world_from_camera = pose_at(0.4, 0.0, 0.0, 0.15, 0.0, 0.0)
    assert sum(mapping.triangulating(world, keyframe, [world.keyframes[0]], FACTORS)) < 25


def test_a_keyframe_that_knows_no_depths_triangulates_nothing():
    cloud = Cloud(200, seed=0)
    world = LocalMap()
    for number in range(2):
        world.add_keyframe(cloud.keyframe(number, pose_at(0.4 * number))[0])
    assert sum(mapping.triangulating(world, world.newest(), [world.keyframes[0]], FACTORS)) == 0


def test_seeds_mature_to_their_true_places():
    cloud = Cloud(500, seed=1)
    world, shown = seeded(cloud, every=2, wrong=1.15)
    keyframe, _ = add(world, cloud, shown, 1, pose_at(0.4))
    rows = world.points.rows(keyframe.points[keyframe.observed()])
    improved = mapping.mature(world, keyframe, FACTORS)
    assert improved > 0.9 * len(rows)
    done = rows[world.points.parallax_deg[rows] > 0]
    true = cloud.positions[shown[world.points.reference_keypoint[done]]]
    error = np.linalg.norm(world.points.position[done] - true, axis=1)
    assert np.median(error / true[:, 2]) < 0.02
    assert (world.points.log_depth_sigma[done] < 0.1).all()
    # The backend hears of their new places.
    assert np.array_equal(np.sort(world.changes.new_points[-1]), np.sort(world.points.ids[done]))
    check(world)
    # Nothing more to gain from the same view.
    assert mapping.mature(world, keyframe, FACTORS) == 0


def test_what_a_view_does_not_improve_keeps_its_place_beside_what_it_does():
    cloud = Cloud(300, seed=1)
    world, shown = seeded(cloud, every=2, wrong=1.02)
    keyframe, _ = add(world, cloud, shown, 1, pose_at(0.4))
    table = world.points
    firm = table.ids % 2 == 0
    table.parallax_deg[firm], table.log_depth_sigma[firm] = 30.0, 0.001
    assert mapping.mature(world, keyframe, FACTORS) > 20
    assert (table.parallax_deg[firm] == 30.0).all()
    assert table.log_depth_sigma[firm] == pytest.approx(0.001)


def test_a_point_whose_first_view_was_found_wrong_is_not_placed_by_it():
    cloud = Cloud(500, seed=1)
    world, shown = seeded(cloud, every=2, wrong=1.15)
    keyframe, _ = add(world, cloud, shown, 1, pose_at(0.4))
    wrong = keyframe.points[keyframe.observed()[:20]]
    world.keyframes[0].points[np.isin(world.keyframes[0].points, wrong)] = -1
    rows = world.points.rows(wrong)
    before = world.points.position[rows].copy()
    assert mapping.mature(world, keyframe, FACTORS) > 50
    assert np.array_equal(world.points.position[rows], before)
    assert not world.points.parallax_deg[rows].any()


def test_a_point_adjusted_over_many_views_keeps_its_place():
    cloud = Cloud(300, seed=1)
    world, shown = seeded(cloud, every=2)
    world.points.parallax_deg[:] = 3.0
    before = world.points.position.copy()
    keyframe, _ = add(world, cloud, shown, 1, pose_at(0.6), noise_px=0.5)
    assert mapping.mature(world, keyframe, FACTORS) > 20
    assert np.array_equal(world.points.position, before)
    assert world.points.parallax_deg.max() > 5.0


def test_two_cameras_that_face_each_other_do_not_place_what_is_between_them():
    world = LocalMap()
    ahead, facing = np.eye(4), np.diag([-1.0, 1.0, -1.0, 1.0])
    facing[2, 3] = 8.0
    cloud = Cloud(50, seed=0)
    middle = np.array([[CAMERA.cx, CAMERA.cy]])
    for number, pose in enumerate((ahead, facing)):
        keyframe, shown = cloud.keyframe(number, pose)
        features = keyframe.features
        seen = len(features)
        # Two corners, alike in both, in the very middle: one will be a point, the other is free.
        pixels = np.vstack([features.pixels, middle, middle])
        octaves = np.append(features.octaves, [3, 3])
        alike = np.arange(8, dtype=np.uint64).reshape(2, 4) * 0x0F0F0F0F0F0F
        words = np.vstack([features.descriptors, alike])
        keyframe.features = Features.build(pixels, octaves, words, CAMERA.width, CAMERA.height)
        keyframe.points = np.full(seen + 2, -1, np.int64)
        world.add_keyframe(keyframe)
        if number == 0:
            world.add_points(keyframe, np.arange(seen), cloud.positions[shown], np.full(seen, 0.01), 30.0)
            place, sigma = np.array([[0.0, 0.0, 3.0]]), np.array([0.2])
            between = world.add_points(keyframe, np.array([seen]), place, sigma, 0.0)
        else:
            row = world.points.rows(between)
            world.add_observation(int(between[0]), int(row[0]), keyframe, seen)
    # Where on the line between both it lies, neither can say.
    assert mapping.mature(world, keyframe, FACTORS) == 0
    assert world.points.position[row[0]] == pytest.approx([0, 0, 3.0])
    with np.errstate(invalid="raise"):
        assert sum(mapping.triangulating(world, world.keyframes[0], [keyframe], FACTORS)) == 0


def test_sharing_lets_a_keyframe_observe_what_another_has():
    cloud = Cloud(400, seed=3)
    world, shown = cloud.mapped([np.eye(4)])
    other, seen = cloud.keyframe(1, pose_at(0.2), noise_px=0.3, bits=10)
    world.add_keyframe(other)
    first = world.keyframes[0]
    doubles = share(world, first, other)
    added = len(other.observed())
    assert added > 0.85 * len(np.intersect1d(shown[0], seen))
    assert len(doubles[0]) == len(doubles[1]) == 0
    check(world)
    # The right ones: a keypoint got the point of the corner that it shows.
    point_of = dict(zip(shown[0].tolist(), first.points.tolist(), strict=True))
    for k in other.observed().tolist():
        assert other.points[k] == point_of[int(seen[k])]
    assert len(world.changes.late) == added
    share(world, first, other)
    assert len(world.changes.late) == added


def test_a_keyframe_that_sees_a_point_does_not_see_it_once_more():
    """Beside its keypoint there is another that looks even more like it."""
    cloud = Cloud(300, seed=2)
    world, _ = cloud.mapped([np.eye(4), pose_at(0.1)])
    first, target = world.keyframes.values()
    keypoint = np.flatnonzero(np.isin(target.points, first.points[first.observed()]))[0]
    old = target.features
    words = old.descriptors.copy()
    words[keypoint] ^= np.uint64(2**30 - 1)
    target.features = Features.build(
        np.concatenate([old.pixels, old.pixels[[keypoint]] + 1.0]),
        np.concatenate([old.octaves, old.octaves[[keypoint]]]),
        np.concatenate([words, old.descriptors[[keypoint]]]),
        CAMERA.width,
        CAMERA.height,
    )
    target.points = np.append(target.points, -1)
    share(world, first, target)
    assert (target.points == target.points[keypoint]).sum() == 1
    check(world)


def test_of_many_neighbours_the_newest_that_are_there_are_remembered():
    world, _ = Cloud(200, seed=0).mapped([pose_at(0.01 * i) for i in range(16)])
    for keyframe in world.keyframes.values():
        keyframe.neighbours = [31, 0, 30, *range(1, 14)]
    mapping.introduce(world, world.newest())
    assert len(world.newest().neighbours) == mapping.NEIGHBOURS
    beside = world.keyframes[world.newest().neighbours[0]]
    assert beside.neighbours == [15, *range(mapping.NEIGHBOURS - 1)], "30 and 31 have been culled"


def test_doubles_are_fused_when_shared():
    """Both keyframes made points of their own from the same corners."""
    cloud = Cloud(300, seed=4)
    world, shown = cloud.mapped([np.eye(4)])
    other, seen = cloud.keyframe(1, pose_at(0.2), noise_px=0.2)
    world.add_keyframe(other)
    mine = other.free()
    world.add_points(other, mine, cloud.positions[seen[mine]], np.full(len(mine), 0.01), 5.0)
    common = len(np.intersect1d(shown[0], seen))
    before = int(world.points.alive.sum())
    first, second = share(world, world.keyframes[0], other)
    assert len(first) > 0.85 * common
    assert world.points.position[first] == pytest.approx(world.points.position[second])
    mapping.fuse(world, first, second)
    assert before - world.points.alive.sum() == len(first) == len(world.changes.fused)
    check(world)


def test_points_that_look_away_or_are_doubtful_are_not_shared():
    cloud = Cloud(200, seed=5)
    for change in ("doubtful", "looks away"):
        world, _ = cloud.mapped([np.eye(4)], sigma=0.2 if change == "doubtful" else 0.01)
        if change == "looks away":
            world.points.direction[:] *= -1
        other, _ = cloud.keyframe(1, pose_at(0.1))
        world.add_keyframe(other)
        share(world, world.keyframes[0], other)
        assert len(other.observed()) == 0


def test_fusing_keeps_the_better_observed_and_all_that_saw_either():
    cloud = Cloud(100, seed=6)
    world, _ = cloud.mapped([np.eye(4), pose_at(0.1)])
    a = int(np.flatnonzero(world.points.observations == 2)[0])
    third, _ = cloud.keyframe(2, pose_at(0.2))
    world.add_keyframe(third)
    b = int(world.add_points(third, np.array([0]), np.ones((1, 3)), np.array([0.1]), 0.0)[0])
    table = world.points
    table.visible[[a, b]], table.found[[a, b]] = (10, 5), (7, 4)
    place = table.position[a].copy()
    mapping.fuse(world, np.array([b]), np.array([a]))
    assert table.known(np.array([a, b])).tolist() == [True, False]
    assert (table.observations[a], table.visible[a], table.found[a]) == (3, 15, 11)
    assert np.array_equal(table.position[a], place)
    assert third.points[0] == a
    assert world.changes.fused == [(b, a)]
    # Nobody is fused with himself or with the dead.
    mapping.fuse(world, np.array([a, a]), np.array([a, b]))
    assert world.changes.fused == [(b, a)]
    check(world)


@pytest.mark.parametrize("pairs", [[(0, 1), (1, 2)], [(1, 2), (0, 1)]])
def test_of_a_chain_the_first_two_become_one(pairs):
    """What has become another takes nothing in, and what took one in becomes no other."""
    world, _ = Cloud(200, seed=0).mapped([np.eye(4), pose_at(0.1)])
    keep, drop = world.points.ids[np.array(pairs).T * 40]
    mapping.merge(world, keep, drop)
    assert world.points.known(np.array([keep[0], drop[0]])).tolist() == [True, False]
    assert world.points.known(world.points.ids[[0, 40, 80]]).sum() == 2
    check(world)


def test_two_points_of_a_keyframe_that_become_a_third_leave_it_one_observation():
    world, _ = Cloud(400, seed=0).mapped([pose_at(0.3 * i) for i in range(4)])
    view = world.keyframes[0]
    one, other = view.points[view.observed()[:2]].tolist()
    third = int(world.points.ids[~np.isin(world.points.ids, view.points)][0])
    mapping.merge(world, np.array([third, third]), np.array([one, other]))
    assert np.count_nonzero(view.points == third) == 1
    check(world)


def test_rarely_found_and_lonely_points_are_culled():
    cloud = Cloud(120, seed=7)
    world, _ = cloud.mapped([pose_at(0.05 * i) for i in range(4)])
    table = world.points
    table.reference[:] = 0
    table.visible[:], table.found[:] = 20, 20
    table.found[:10] = 4  # below a quarter
    table.visible[10:20], table.found[10:20] = 8, 0  # not looked for often enough to tell
    lonely = table.observations < 2
    lonely[:20] = False
    mapping.cull_recent_points(world, newest=3)
    assert not table.alive[:10].any()
    assert table.alive[10:20].all() or (table.observations[10:20] < 2).any()
    assert not table.alive[lonely].any()
    check(world)
    culled = np.concatenate(world.changes.culled_points)
    assert np.array_equal(np.sort(culled), table.ids[~table.alive])


def test_old_points_are_left_to_the_backend():
    cloud = Cloud(120, seed=7)
    world, _ = cloud.mapped([np.eye(4)])
    world.points.found[:], world.points.visible[:] = 0, 100
    mapping.cull_recent_points(world, newest=20)
    assert world.points.alive.all()


def test_triangulation_does_not_depend_on_where_the_world_s_origin_is():
    cloud = Cloud(300, seed=8)
    moved = pose_at(5.0, -3.0, 2.0, 0.3, 0.5, -0.2)
    created = []
    for motion in (np.eye(4), moved):
        fresh = Cloud(300, seed=8)
        world, shown = seeded(fresh)
        keyframe, _ = add(world, fresh, shown, 1, pose_at(0.4))
        for k in world.keyframes.values():
            k.world_from_camera = motion @ k.world_from_camera
        world.points.position[:] = transform(motion, world.points.position)
        list(mapping.triangulating(world, keyframe, [world.keyframes[0]], FACTORS))
        back = transform(np.linalg.inv(motion), world.points.position)
        created.append(back)
    assert created[0] == pytest.approx(created[1], abs=1e-9)
    assert len(created[0]) > len(cloud.positions) // 2


@pytest.mark.parametrize(("near", "far", "same"), [(2, 1, True), (1, 2, False)])
def test_a_corner_must_look_smaller_where_it_is_farther(near, far, same):
    """Of what is 1.6 times as far from one keyframe as from the other: levels are a factor of 1.2 apart."""
    cloud = Cloud(500, seed=0)
    world, shown = seeded(cloud)
    keyframe, _ = add(world, cloud, shown, 1, pose_at(0.3, 0.0, 1.2), noise_px=0.0)
    for view, level in ((keyframe, near), (world.keyframes[0], far)):
        features, levels = view.features, np.full(len(view.features), level, np.intp)
        view.features = Features.build(features.pixels, levels, features.descriptors, 640, 480)
    list(mapping.triangulating(world, keyframe, [world.keyframes[0]], FACTORS))
    z = world.points.position[world.points.reference == 1][:, 2]
    farther = z / (z - 1.2) > 1.6
    assert (farther.sum() > 20) == same
    assert farther.any() == same


@pytest.mark.parametrize(
    ("age", "views", "goes"), [(2, 1, False), (3, 1, True), (8, 1, True), (9, 1, False), (5, 2, False)]
)
def test_what_one_keyframe_alone_sees_goes_once_others_had_their_chance(age, views, goes):
    world, _ = Cloud(120, seed=7).mapped([np.eye(4)] * views)
    world.points.reference[:] = 30 - age
    mapping.cull_recent_points(world, newest=30)
    assert world.points.alive.any() != goes


@pytest.mark.parametrize(("age", "goes"), [(4, True), (5, False)])
def test_what_is_rarely_found_goes_while_it_is_young_however_long_the_map(age, goes):
    world, _ = Cloud(120, seed=7).mapped([np.eye(4)] * 2)
    world.points.reference[:], world.points.visible[:] = 30 - age, 20
    mapping.cull_recent_points(world, newest=30)
    assert world.points.alive.any() != goes
    mapping.cull_recent_points(world, newest=30)
    told = [point for ids in world.changes.culled_points for point in ids.tolist()]
    assert len(told) == len(set(told)), "what is gone does not go again"
