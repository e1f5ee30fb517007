"""The tracker on a generated film: what it gives, against the truth; how its map begins and is corrected."""

from __future__ import annotations

import numpy as np
import pytest

from prism_edge.geometry.poses import inverse, se3_log, transform
from prism_edge.messages import INITIALISING, OK
from prism_edge.tracking import seeding
from prism_edge.tracking.announcement import keyframe_message
from tests.synthetic.messages import map_update
from tests.tracking.cloud import check, pose_at
from tests.tracking.film_run import BLACK, CONFIG, Run
from tests.tracking.footage import IDENTITY, RATE_HZ, footage


@pytest.fixture(scope="module")
def whole() -> Run:
    """The film from its beginning, depth for each keyframe at once."""
    run = Run()
    run.play(range(75))
    return run


def travelled(frames: range) -> float:
    path = np.array([pose[:3, 3] for pose in footage().poses])[frames.start : frames.stop]
    return float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())


def test_it_follows_the_camera(whole):
    assert whole.results[0].odometry == INITIALISING
    assert whole.results[0].world_from_camera is None
    assert all(whole.results[i].odometry == OK for i in range(1, 75))
    assert travelled(range(75)) > 0.8
    assert whole.errors(range(1, 75)).max() < 0.04
    truth = footage().poses
    turn = [se3_log(inverse(truth[i]) @ whole.results[i].world_from_camera)[3:] for i in range(1, 75)]
    assert np.linalg.norm(turn, axis=1).max() < np.radians(0.8)


def test_keyframes_come_as_the_camera_moves(whole):
    assert whole.keyframes[0] == 0
    assert 2 <= len(whole.keyframes) <= 15
    assert list(whole.keyframes) == list(range(len(whole.keyframes)))
    check(whole.tracker.world)


def test_keyframes_say_how_the_camera_moved(whole):
    truth, keyframes = footage().poses, list(whole.tracker.world.keyframes.values())
    assert not keyframes[0].twist.any(), "nothing tells of the first"
    is_moving = []
    for keyframe in keyframes[1:]:
        true = se3_log(inverse(truth[keyframe.index - 1]) @ truth[keyframe.index]) * RATE_HZ
        off = keyframe.twist - true
        # A pose of so small an image is half a centimetre off, thirty times a second.
        assert np.linalg.norm(off[:3]) < 0.25
        assert np.linalg.norm(off[3:]) < 0.07
        is_moving.append(np.linalg.norm(true[:3]) > 0.25 and np.linalg.norm(true[3:]) > 0.07)
    # Which of them the camera rests at is a matter of where keyframes are made.
    assert sum(is_moving) >= 3, "a twist of nothing would be off by as much"


def test_a_frame_hangs_on_its_keyframe(whole):
    world = whole.tracker.world
    result = whole.results[74]
    carried = world.keyframes[result.reference].world_from_camera @ result.reference_from_camera
    assert carried == pytest.approx(result.world_from_camera, abs=1e-9)


def test_points_are_on_the_surfaces_that_were_drawn(whole):
    """Each triangulated point, seen from its newest keyframe, is where the exact depth says."""
    world, film = whole.tracker.world, footage()
    keyframe = world.newest()
    keypoints, depths = world.depths_in(keyframe)
    firm = world.points.parallax_deg[world.points.rows(keyframe.points[keypoints])] > 2.0
    assert firm.sum() > 30
    x, y = np.rint(keyframe.features.pixels[keypoints[firm]]).astype(int).T
    true = film.depths[keyframe.index][y, x]
    assert np.median(np.abs(depths[firm] / true - 1.0)) < 0.04


def test_covariances_are_proper_and_small_where_much_is_seen(whole):
    for i in range(1, 75):
        covariance = whole.results[i].covariance
        assert covariance == pytest.approx(covariance.T, rel=1e-6, abs=1e-15)
        values = np.linalg.eigvalsh(covariance)
        assert values[0] > 0
        if i > whole.keyframes[1]:  # before, nothing but depth says how far it moved: test_baseline.py
            assert np.sqrt(values[-1]) < 0.05


def test_the_same_film_gives_the_same_poses(whole):
    again = Run()
    again.play(range(40))
    for i in range(1, 40):
        assert np.array_equal(again.results[i].world_from_camera, whole.results[i].world_from_camera)


def test_nothing_is_published_before_depth_has_come():
    run = Run()
    for i in range(8):
        assert run.feed(i).odometry == INITIALISING
    assert run.depth(0) > 100
    assert run.feed(8).odometry == OK
    assert run.errors(range(8, 9))[0] < 0.02


def test_the_unit_is_what_the_first_depth_gave_it():
    run = Run()
    run.feed(0)
    run.depth(0, factor=1.3)
    run.play(range(1, 30), depth_for="none")
    moved, true = (pose[:3, 3] for pose in (run.results[29].world_from_camera, footage().poses[29]))
    assert np.linalg.norm(moved) / np.linalg.norm(true) == pytest.approx(1.3, rel=0.06)


def test_depth_is_put_into_the_map_s_unit():
    """With log_scale = log 2 a unit is two metres: what comes in metres is halved."""
    run = Run()
    run.tracker.log_scale = np.log(2.0)
    run.feed(0)
    run.depth(0)
    _, depths = run.tracker.world.depths_in(run.tracker.world.newest())
    assert np.median(depths) == pytest.approx(np.median(footage().depths[0]) / 2.0, rel=0.25)


def test_later_depth_is_put_there_by_the_map_s_own_scale(monkeypatch):
    """What is published may be held farther from the estimate."""
    monkeypatch.setattr(seeding, "MIN_ALIGNED", 10**6)  # as if no point were firm
    run = Run()
    run.play(range(30), depth_for="first")
    run.tracker.log_scale, run.tracker.map_log_scale = np.log(3.0), np.log(2.0)
    newest, world = max(run.keyframes), run.tracker.world
    known = len(world.points)
    assert run.depth(newest) > 20
    keypoints, depths = world.depths_in(world.newest())
    seeded = world.points.rows(world.newest().points[keypoints]) >= known
    true = footage().depths[run.keyframes[newest]]
    assert np.median(depths[seeded]) == pytest.approx(np.median(true) / 2.0, rel=0.25)


def test_it_goes_on_when_nobody_answers_after_the_start():
    run = Run()
    run.play(range(75), depth_for="first")
    assert all(run.results[i].odometry == OK for i in range(1, 75))
    assert run.errors(range(1, 75)).max() < 0.06
    assert len(run.keyframes) >= 2


def test_images_without_corners_begin_nothing():
    run = Run()
    for i in range(5):
        assert run.feed(0, BLACK, at=i).odometry == INITIALISING
    assert not run.keyframes
    run.feed(5)
    assert run.keyframes == {0: 5}


def test_a_first_keyframe_that_can_t_be_tracked_is_replaced():
    run = Run()
    run.feed(0)
    run.depth(0)
    noise = np.random.default_rng(0)
    for i in range(1, 50):
        result = run.feed(0, noise.integers(0, 255, (240, 320), dtype=np.uint8), at=i)
        assert result.odometry == INITIALISING
    assert run.tracker.epoch >= 1
    assert len(run.keyframes) >= 2
    # The new first keyframe is another, with an id of its own; with its depth tracking begins.
    run.feed(20, at=50)
    while max(run.keyframes.values()) != 50:
        at = max(run.results) + 1
        run.feed(20, at=at)
        if run.keyframes[max(run.keyframes)] == at:
            break
    run.depth(max(run.keyframes), of=20)
    assert run.feed(21, at=max(run.results) + 1).odometry == OK
    assert run.tracker.log_scale == 0.0


def test_depth_that_takes_seconds_still_starts_a_camera_that_waits():
    """A large network on a small computer: the first depth is two seconds late."""
    run = Run()
    for i in range(60):
        assert run.feed(0, at=i).odometry == INITIALISING
    assert list(run.keyframes) == [0]
    assert run.depth(0) > 100
    assert run.feed(0, at=60).odometry == OK
    assert run.tracker.epoch == 0


def test_a_first_keyframe_whose_depth_never_comes_is_replaced_at_last():
    run = Run()
    for i in range(0, 3000, 15):
        run.feed(0, at=i)
    assert len(run.keyframes) > 2
    assert run.tracker.epoch == len(run.keyframes) - 1


def test_depth_of_a_keyframe_that_is_gone_is_no_matter():
    run = Run()
    run.feed(0)
    assert run.tracker.add_depth(99, footage().depths[0], IDENTITY, 0.1) == 0


def test_depth_for_an_announced_keyframe_is_told_with_the_next():
    run = Run()
    run.feed(0)
    keyframe_message(run.tracker, run.tracker.world.keyframes[0])
    count = run.depth(0)
    late = run.tracker.world.changes.late
    assert len(late) == count
    points = run.tracker.world.keyframes[0].points
    assert all(k == 0 and points[keypoint] == p for p, k, keypoint in late)


def test_a_keyframe_whose_depth_is_of_no_use_is_given_points_all_the_same():
    """It would be lost in the next turn; and the backend hears of them."""
    run = Run()
    run.play(range(30), depth_for="first")
    world = run.tracker.world
    keyframe = world.newest()
    lost = keyframe.observed()[5:]
    world.cull_points(world.points.rows(keyframe.points[lost]))
    keyframe_message(run.tracker, keyframe)
    run.tracker.add_no_depth(keyframe.id)
    assert len(keyframe.observed()) == CONFIG.features // 3
    told = [(point, keypoint) for point, k, keypoint in world.changes.late if k == keyframe.id]
    assert len(told) == CONFIG.features // 3 - 5
    assert all(keyframe.points[keypoint] == point for point, keypoint in told)


def test_a_correction_moves_the_map_and_the_last_frame_alike():
    """Two runs, one of them corrected rigidly on the way: relative to its world it sees the same."""
    motion = pose_at(0.4, -0.1, 0.2, 0.02, 0.15, -0.05)
    run, plain = Run(), Run()
    run.play(range(40))
    plain.play(range(40))
    world = run.tracker.world
    before = run.tracker.last_pose()
    ids = world.points.ids[world.points.alive].copy()
    run.tracker.apply_update(
        map_update(
            world.newest().id,
            keyframes=np.array(list(world.keyframes)),
            poses=np.array([motion @ k.world_from_camera for k in world.keyframes.values()]),
            points=ids,
            positions=transform(motion, world.points.position[world.points.rows(ids)]),
            parallax_deg=np.zeros(len(ids), np.float32),
        )
    )
    # The last frame is fitted anew, to points with the noise that they have.
    assert np.abs(se3_log(inverse(motion @ before) @ run.tracker.last_pose())).max() < 0.01
    for i in range(40, 50):
        run.feed(i)
        plain.feed(i)
        assert run.results[i].odometry == OK
        step = inverse(motion) @ run.results[i].world_from_camera
        assert np.linalg.norm((step - plain.results[i].world_from_camera)[:3, 3]) < 0.02


def test_observations_the_backend_found_wrong_are_dropped():
    run = Run()
    run.play(range(30))
    world = run.tracker.world
    keyframe = world.newest()
    wrong = keyframe.points[keyframe.observed()][:20].copy()
    run.tracker.apply_update(
        map_update(keyframe.id, dropped_keyframes=np.full(20, keyframe.id), dropped_points=wrong)
    )
    assert not np.isin(keyframe.points, wrong).any()
    check(world)
    assert run.feed(30).odometry == OK


def test_a_frame_that_nobody_judged_becomes_no_keyframe_under_a_later_picture():
    """While only localising, frames are tracked and not judged; mapping is on again when nothing is seen."""
    run = Run()
    run.play(range(30))
    made, film = len(run.keyframes), footage()
    for i in range(30, 60):
        tracked = run.tracker.process(i, film.stamp_ns(i), film.images[i], film.camera)
        assert tracked.world_from_camera is not None
    for i in range(60, 63):
        assert run.feed(i, BLACK).world_from_camera is None
    assert len(run.keyframes) == made
