"""A first map from a network that is at a loss: its second view puts it right."""

from __future__ import annotations

import numpy as np
import pytest

from prism_edge.geometry.poses import inverse, rotation_angle, transform
from prism_edge.tracking import first_map
from prism_edge.tracking.first_map import CAN_WAIT_MATCHES, SecondView, begin_structure
from prism_edge.tracking.frame_tracking import TrackedFrame
from prism_edge.tracking.initialisation import TwoViews
from prism_edge.tracking.local_map import NO_POINT
from prism_edge.tracking.mapping import MATCHING_SIGMA_PX
from tests.tracking.cloud import CAMERA, Cloud, pose_at
from tests.tracking.film_run import Run
from tests.tracking.footage import IDENTITY, footage


def reversed_depth(depth: np.ndarray, power: float = 1.0) -> np.ndarray:
    """What is near is far, and the reverse."""
    middle = float(np.median(depth))
    return (middle * (middle / depth) ** power).astype(np.float32)


def slanted(depth: np.ndarray) -> np.ndarray:
    """A wall that recedes from left to right."""
    columns = np.median(depth) * np.exp(np.linspace(-1.0, 1.0, depth.shape[1]))
    return np.tile(columns, (depth.shape[0], 1)).astype(np.float32)


def until_the_second_keyframe(start: int, depth: np.ndarray) -> tuple[Run, int]:
    """The film from a frame on, with a depth for the first image alone; and the second keyframe's frame.

    -1 where a second is still waited for after 30 frames.
    """
    run = Run()
    run.feed(start, at=0)
    run.tracker.add_depth(0, depth, IDENTITY, 0.1)
    for i in range(1, 30):
        run.feed(start + i, at=i)
        if len(run.keyframes) == 2:
            return run, start + i
    return run, -1


def flat(depth: np.ndarray) -> np.ndarray:
    return np.full_like(depth, np.median(depth))


def twice_reversed(depth: np.ndarray) -> np.ndarray:
    return reversed_depth(depth, 2.0)


def off(run: Run, start: int, index: int) -> tuple[float, float]:
    """How far the first motion is turned, and how far it points aside; degrees."""
    film, found = footage(), run.tracker.world.newest().world_from_camera
    true = inverse(film.poses[start]) @ film.poses[index]
    lengths = np.linalg.norm(found[:3, 3]) * np.linalg.norm(true[:3, 3])
    cosine = found[:3, 3] @ true[:3, 3] / max(lengths, 1e-9)
    angle = rotation_angle(found[:3, :3].T @ true[:3, :3])
    return float(np.degrees(angle)), float(np.degrees(np.arccos(min(cosine, 1.0))))


def structure(run: Run, index: int) -> tuple[int, float]:
    """Points that the second keyframe sees from two sides; and how far their depths scatter."""
    film, world = footage(), run.tracker.world
    keypoints, depths = world.depths_in(world.newest())
    firm = world.points.parallax_deg[world.points.rows(world.newest().points[keypoints])] > 1.0
    x, y = np.rint(world.newest().features.pixels[keypoints[firm]]).astype(int).T
    ratios = np.log(depths[firm] / film.depths[index][y, x])
    return len(ratios), float(np.median(np.abs(ratios - np.median(ratios)))) if len(ratios) else np.inf


@pytest.mark.parametrize(
    ("start", "wrong"),
    [
        (0, flat),
        (15, reversed_depth),
        (45, reversed_depth),
        (45, twice_reversed),
        (45, slanted),
    ],
    ids=["flat", "reversed", "reversed, a turn", "twice so", "slanted"],
)
def test_matches_by_looks_alone_free_the_map_from_wrong_depths(start, wrong):
    """What tracking found at wrong depths agrees with the wrong motion they led to: a turn for a way."""
    run, index = until_the_second_keyframe(start, wrong(footage().depths[start]))
    assert index >= 0, "there was no second keyframe"
    turned, aside = off(run, start, index)
    assert turned < 0.3
    assert aside < 8.0
    firm, scattered = structure(run, index)
    assert firm >= 50
    assert scattered < 0.1


def test_the_frame_is_carried_to_where_the_second_view_has_it():
    """Said before the second view was looked at, its place beside the first was what wrong depths made it."""
    run, index = until_the_second_keyframe(0, flat(footage().depths[0]))
    first, second = (run.tracker.world.keyframes[k] for k in sorted(run.keyframes))
    said, later = run.results[index], run.tracker.last_result
    assert np.abs(said.world_from_camera - second.world_from_camera).max() > 0.01, "it was moved"
    assert later.reference == first.id
    carried = first.world_from_camera @ later.reference_from_camera
    assert np.allclose(carried, second.world_from_camera, atol=1e-9)


def test_a_motion_that_wrong_depths_made_is_not_gone_on_with():
    run, _ = until_the_second_keyframe(0, flat(footage().depths[0]))
    pose, motion = run.tracker.last_pose(), run.tracker.motion
    assert np.array_equal(motion.predict(pose, motion.stamp_ns + 100_000_000), pose)


def test_so_it_is_from_most_starts():
    """One start alone is luck: a pixel's difference moves it by as much as the median.

    Judged by what tracking found, motions point 6.8 degrees aside (median of these), and nine maps of sixty
    are good for nothing.
    """
    film = footage()
    motions, scatter, useless = [], [], 0
    for wrong in (flat, reversed_depth, twice_reversed, slanted):
        for start in range(0, 45, 3):
            run, index = until_the_second_keyframe(start, wrong(film.depths[start]))
            if index < 0:
                useless += 1
                continue
            turned, aside = off(run, start, index)
            firm, scattered = structure(run, index)
            useless += turned > 5.0 or aside > 30.0 or firm < 50
            motions.append((turned, aside))
            scatter.append(scattered)
    turned, aside = np.median(motions, axis=0)
    assert turned < 0.4
    assert aside < 5.5
    assert np.median(scatter) < 0.1
    assert useless <= 6


def test_depths_that_agree_with_the_matches_stay():
    film = footage()
    run, index = until_the_second_keyframe(0, film.depths[0])
    error = run.tracker.world.newest().world_from_camera - film.poses[index]
    assert np.linalg.norm(error[:3, 3]) < 0.01
    first = run.tracker.world.keyframes[0]
    assert len(first.observed()) > 300, "what the network gave is still there"


def after_a_turn(believed: np.ndarray, found: int = 60, by_chance: int = 0) -> SecondView:
    """What becomes of a view turned by 11 degrees, of which tracking has ``found`` points and this pose.

    A thousand corners look alike, as in a large image; so do ``by_chance`` that lie anywhere in it.
    """
    cloud, turned = Cloud(2000), pose_at(0.0, 0.0, 0.0, 0.0, 0.2)
    world, _ = cloud.mapped([pose_at()], parallax_deg=0.0)
    first = world.newest()
    features, _ = cloud.view(turned, noise_px=0.5)
    rng = np.random.default_rng(2)
    anywhere = rng.permutation(len(features))[:by_chance]
    features.pixels[anywhere] = rng.uniform(0.0, (CAMERA.width, CAMERA.height), (by_chance, 2))
    points = np.full(len(features), NO_POINT, np.int64)
    points[:found] = first.points[first.observed()[:found]]
    frame = TrackedFrame(CAMERA, features, believed, points, np.zeros((6, 6)), found)
    return begin_structure(world, first, frame, seed=0)


def test_a_turn_that_tracking_knows_of_may_become_a_keyframe_however_much_looks_alike():
    """Else the camera that has lost most of its few points waits for parallax until it has lost all."""
    assert after_a_turn(pose_at(0.0, 0.0, 0.0, 0.0, 0.2)) is SecondView.AGREES


@pytest.mark.parametrize("by_chance", [0, 300])
def test_a_turn_that_tracking_has_missed_waits(by_chance: int):
    assert after_a_turn(pose_at(), by_chance=by_chance) is SecondView.TOO_NEAR


def test_corners_that_match_anywhere_say_nothing_against_a_turn():
    """Of an image of 1280 x 960 some 130 do: its map stayed one keyframe until that was out of sight."""
    assert after_a_turn(pose_at(0.0, 0.0, 0.0, 0.0, 0.2), by_chance=300) is SecondView.AGREES


def test_a_turn_waits_while_its_points_are_many():
    assert after_a_turn(pose_at(0.0, 0.0, 0.0, 0.0, 0.2), found=100) is SecondView.TOO_NEAR


@pytest.mark.parametrize(
    ("aside_deg", "matched", "said"),
    [
        (65.0, CAN_WAIT_MATCHES, SecondView.TOO_NEAR),
        (180.0, CAN_WAIT_MATCHES, SecondView.TOO_NEAR),
        (55.0, CAN_WAIT_MATCHES, SecondView.AGREES),
        (180.0, CAN_WAIT_MATCHES - 1, SecondView.AGREES),
    ],
)
def test_two_ways_that_the_matches_allow_wait_for_more_parallax(monkeypatch, aside_deg, matched, said):
    """Else the map goes on with the wrong one of a step to the left and a turn to the right."""
    cloud, aside = Cloud(500), np.radians(aside_deg)
    world, _ = cloud.mapped([pose_at()], parallax_deg=0.0)
    tracked, found = pose_at(0.1), pose_at(0.2 * np.cos(aside), 0.2 * np.sin(aside))
    features, _ = cloud.view(tracked)
    points = np.full(len(features), NO_POINT)
    frame = TrackedFrame(CAMERA, features, tracked, points, np.zeros((6, 6)), matched)
    views = TwoViews(found, np.zeros((0, 3)), np.zeros(0), np.zeros(0, bool), 0.2, contradicts=False)
    monkeypatch.setattr(first_map, "two_views", lambda *_: (views, np.zeros(0, np.int64)))
    assert begin_structure(world, world.newest(), frame, seed=0) is said


@pytest.mark.parametrize(("moving", "unseated"), [(0.2, True), (0.5, False)])
def test_two_views_unseat_the_network_only_where_most_corners_fit_them(moving, unseated):
    """Two objects that cross the picture, each its own way, fit a wrong motion as wrong depths do."""
    cloud, second = Cloud(2000), pose_at(0.5, 0.1, 0.0, 0.0, -0.05)
    world, _ = cloud.mapped([pose_at()], parallax_deg=0.0)
    table = world.points
    table.position[:] *= (3.0 / table.position[:, 2])[:, None]
    before = table.position.copy()
    features, _ = cloud.view(second, noise_px=0.3)
    across = np.argsort(features.pixels[:, 0])
    objects = np.array_split(across[: int(moving * len(across))], 2)
    for on_it, way in zip(objects, (30.0, -30.0), strict=True):
        features.pixels[on_it] += (0.3 * way, way)
    points = np.full(len(features), NO_POINT, np.int64)
    frame = TrackedFrame(CAMERA, features, pose_at(0.2), points, np.zeros((6, 6)), 60)
    said = begin_structure(world, world.newest(), frame, seed=0)
    assert (said is SecondView.CONTRADICTS) == unseated
    assert np.array_equal(table.position, before) != unseated


def test_points_that_two_views_moved_are_told():
    """The backend has them where the network's depth put them, and must hear of it."""
    cloud, second = Cloud(2000), pose_at(0.5, 0.1, 0.0, 0.0, -0.05)
    world, _ = cloud.mapped([pose_at()], parallax_deg=0.0)
    first, table = world.newest(), world.points
    table.position[:] *= (3.0 / table.position[:, 2])[:, None]  # all of one depth
    world.changes.new_points.clear()
    features, _ = cloud.view(second, noise_px=0.3)
    points = np.full(len(features), NO_POINT, np.int64)
    frame = TrackedFrame(CAMERA, features, pose_at(0.2), points, np.zeros((6, 6)), 60)
    before = dict(zip(table.ids.tolist(), table.position.copy(), strict=True))
    assert begin_structure(world, first, frame, seed=0) is SecondView.CONTRADICTS
    now = dict(zip(table.ids.tolist(), table.position, strict=True))
    moved = {p for p, place in now.items() if not np.array_equal(place, before[p])}
    assert len(moved) > 100
    assert set(np.concatenate(world.changes.new_points).tolist()) >= moved


def test_points_of_two_views_are_as_well_known_as_their_parallax_has_them():
    """Not as the network's: a pixel of noise at their angle."""
    cloud, second = Cloud(2000), pose_at(0.5, 0.1, 0.0, 0.0, -0.05)
    world, _ = cloud.mapped([pose_at()], parallax_deg=0.0)
    first, table = world.newest(), world.points
    table.position[:] *= (3.0 / table.position[:, 2])[:, None]
    table.log_depth_sigma[:] = 0.5
    features, _ = cloud.view(second, noise_px=0.3)
    points = np.full(len(features), NO_POINT, np.int64)
    frame = TrackedFrame(CAMERA, features, pose_at(0.2), points, np.zeros((6, 6)), 60)
    assert begin_structure(world, first, frame, seed=0) is SecondView.CONTRADICTS
    rows = table.rows(frame.points[frame.points != NO_POINT])
    assert len(rows) > 100
    expected = MATCHING_SIGMA_PX / (CAMERA.fx * np.radians(table.parallax_deg[rows]))
    assert table.log_depth_sigma[rows] == pytest.approx(np.minimum(expected, 2.0), rel=1e-3)


def test_two_views_that_contradict_depth_leave_nothing_of_what_was_tracked_and_all_of_other_parts():
    cloud, second = Cloud(2000), pose_at(0.5, 0.1, 0.0, 0.0, -0.05)
    world, _ = cloud.mapped([pose_at()], parallax_deg=0.0)
    first, table = world.newest(), world.points
    table.position[:] *= (3.0 / table.position[:, 2])[:, None]
    features, shown = cloud.view(second, noise_px=0.3)
    wrong = np.random.default_rng(3).permutation(table.ids)[: len(features)]
    points = np.r_[wrong, np.full(len(features) - len(wrong), NO_POINT)]
    elsewhere, _ = Cloud(200, seed=9).keyframe(8, pose_at())
    world.add_keyframe(elsewhere)
    everywhere = np.zeros((len(elsewhere.points), 3))
    theirs = world.add_points(elsewhere, elsewhere.free(), everywhere, np.full(len(everywhere), 0.2), 0.0)
    frame = TrackedFrame(CAMERA, features, pose_at(0.2), points, np.zeros((6, 6)), 60)
    assert begin_structure(world, first, frame, seed=0) is SecondView.CONTRADICTS
    assert len(theirs) > 100
    assert table.known(theirs).all()
    at = np.flatnonzero(frame.points != NO_POINT)
    assert len(at) > 100
    assert table.known(frame.points[at]).all()
    corner_of = dict(zip(first.points.tolist(), cloud.view(pose_at())[1].tolist(), strict=True))
    assert [corner_of[point] for point in frame.points[at].tolist()] == shown[at].tolist()


def test_a_part_that_begins_elsewhere_has_its_second_view_beside_its_first():
    """Not where it would be beside the origin; its points neither."""
    start = pose_at(3.0, -1.0, 2.0, 0.1, 0.8, -0.2)
    second = start @ pose_at(0.5, 0.1, 0.0, 0.0, -0.05)
    cloud = Cloud(2000)
    cloud.positions = transform(start, cloud.positions)
    world, _ = cloud.mapped([start], parallax_deg=0.0)
    first, table = world.newest(), world.points
    local = transform(inverse(start), table.position)
    table.position[:] = transform(start, local * (3.0 / local[:, 2])[:, None])  # all of one depth
    features, _ = cloud.view(second, noise_px=0.3)
    points = np.full(len(features), NO_POINT, np.int64)
    frame = TrackedFrame(CAMERA, features, start @ pose_at(0.2), points, np.zeros((6, 6)), 60)
    assert begin_structure(world, first, frame, seed=0) is SecondView.CONTRADICTS
    turned = frame.world_from_camera[:3, :3].T @ second[:3, :3]
    assert np.degrees(rotation_angle(turned)) < 0.5
    at = np.flatnonzero(frame.points != NO_POINT)
    assert len(at) > 100
    seen = transform(inverse(frame.world_from_camera), table.position[table.rows(frame.points[at])])
    assert np.linalg.norm(CAMERA.project(seen) - features.pixels[at], axis=1).max() < 3.0
