"""A tracker carried to another room: it maps there on its own, and is joined to the map it had."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from prism_edge.config import CovarianceConfig
from prism_edge.geometry.poses import inverse, scaled, se3_log, transform
from prism_edge.messages import HOME, INITIALISING, LOST, OK
from prism_edge.tracking.announcement import keyframe_message
from prism_edge.tracking.keyframe_culling import AT_ONCE
from prism_edge.tracking.place_index import PlaceIndex
from prism_edge.tracking.submaps import Parts
from prism_edge.tracking.tracker import Tracker
from tests.synthetic.drawing import SLACK
from tests.synthetic.messages import map_update
from tests.tracking.cloud import check, pose_at, walk
from tests.tracking.film_run import BLACK, CONFIG, Run
from tests.tracking.footage import IDENTITY, footage, other_room


def visit(run: Run, room: list, at: int) -> None:
    """Feed another room from frame ``at`` on, each keyframe's depth at once."""
    for i, (image, depth, _) in enumerate(room, start=at):
        run.feed(0, image, at=i)
        for k, frame in run.keyframes.items():
            if frame == i:
                run.tracker.add_depth(k, depth, IDENTITY, 0.1)


def in_the_dark(frames: int, submap_after_s: float) -> Run:
    """A camera that mapped so many frames, and then saw nothing for twelve."""
    run = Run(tracker=Tracker(replace(CONFIG, submap_after_s=submap_after_s)))
    run.play(range(frames))
    for i in range(frames, frames + 12):
        run.feed(0, BLACK, at=i)
    return run


def place_sigma(run: Run, frame: int) -> float:
    """Of the frame's position along the worst axis."""
    result = run.results[frame]
    own = CovarianceConfig().refinement * np.linalg.eigvalsh(result.covariance[:3, :3])[-1]
    return float(np.hypot(np.sqrt(own), result.unobserved))


@pytest.fixture(scope="module")
def astray() -> tuple[Run, list]:
    """A camera that was carried to another room, and maps there."""
    run, room = in_the_dark(30, 0.4), other_room()
    visit(run, room, at=42)
    return run, room


def test_a_camera_lost_in_the_unknown_maps_on_its_own(astray):
    run, room = astray
    first = next(i for i in range(42, 102) if run.results[i].world_from_camera is not None)
    assert 42 + 10 <= first <= 42 + 20, "0.4 s of looking about in vain"
    tracked = [i for i in range(first, 102) if run.results[i].world_from_camera is not None]
    assert len(tracked) > 0.9 * (102 - first)
    assert not any(run.results[i].in_map for i in tracked)
    assert all(run.results[i].in_map for i in range(5, 30))
    moved = inverse(run.results[first].world_from_camera) @ run.results[101].world_from_camera
    true = inverse(room[first - 42][2]) @ room[101 - 42][2]
    assert np.linalg.norm(moved[:3, 3] - true[:3, 3]) < 0.1 * np.linalg.norm(true[:3, 3]) + 0.02
    assert run.tracker.epoch == 0, "never a reset"
    world, home = run.tracker.world, run.tracker.parts.of(0)
    apart = [k for k in world.keyframes if run.tracker.parts.of(k) != home]
    known = np.concatenate([k.points for k in world.keyframes.values() if k.id not in apart])
    assert len(apart) >= 3
    for k in apart:
        assert not np.isin(world.keyframes[k].points[world.keyframes[k].observed()], known).any()
    # Until two of its views have had parallax its depth is the network's word, as a first map's is.
    assert place_sigma(run, first) > 0.5 * place_sigma(run, 1) > 20 * place_sigma(run, 101)
    jump = run.results[first].world_from_camera[:3, 3] - run.results[29].world_from_camera[:3, 3]
    assert np.linalg.norm(jump) < 0.1, "odom goes on from where it was"
    check(run.tracker.world)


def test_back_in_the_old_map_it_is_found_there(astray):
    run, _ = astray
    for i in range(102, 114):
        run.feed(0, BLACK, at=i)
    found = run.until_found([(12 + i, None) for i in range(12)], at=114)
    assert found.in_map
    off = found.world_from_camera - footage().poses[12 + run.found_at - 114]
    assert np.linalg.norm(off[:3, 3]) < 0.03
    assert run.keyframes[found.reference] < 30, "carried by a keyframe of the same part"


def bring_home(run: Run, motion: np.ndarray, size: float = 1.0) -> None:
    """What the backend says once a loop joins the newer part to the first, whose world it then is in."""
    world = run.tracker.world
    mine = sorted(k for k in world.keyframes if run.tracker.parts.of(k) >= 0)
    ids = np.unique(np.concatenate([world.keyframes[k].points for k in mine]))
    ids = ids[ids >= 0]
    update = map_update(
        mine[-1],
        keyframes=np.array(mine),
        poses=np.array([motion @ scaled(world.keyframes[k].world_from_camera, size) for k in mine]),
        points=ids,
        positions=transform(motion, size * world.points.position[world.points.rows(ids)]),
        parallax_deg=np.zeros(len(ids), np.float32),
    )
    units = np.array([np.log(size), 0.01])
    run.tracker.apply_update(replace(update, loop_query=mine[-1], loop_candidate=0, loop_units=units))


def test_a_loop_between_the_parts_brings_the_camera_home():
    run, room = in_the_dark(20, 0.3), other_room(40)
    visit(run, room, at=32)
    last = run.results[71]
    assert not last.in_map
    assert not run.tracker.last_result.in_map, "nor is what repeats it"
    motion = pose_at(3.0, 0.5, -1.0, 0.2, 0.7, -0.1)
    part = run.tracker.parts.current
    bring_home(run, motion, size=1.0)
    assert run.tracker.parts.take_joined() == [(part, HOME, 0.0, 0.01)]
    assert run.tracker.last_result.in_map, "also for exact copies of that image"
    after = run.feed(0, room[-1][0], at=72)
    assert after.in_map
    off = inverse(motion @ last.world_from_camera) @ after.world_from_camera
    assert np.abs(se3_log(off)).max() < 0.02


@pytest.mark.parametrize("motion", [pose_at(3.0, 0.5, -1.0, 0.2, 1.6, -0.1), pose_at(0, 0, 0, 0, 3.1, 0)])
def test_a_part_that_is_joined_late_takes_nothing_along_of_where_the_camera_is_by_then(motion):
    run, room = in_the_dark(30, 0.4), other_room()
    visit(run, room, at=42)
    assert not run.results[101].in_map
    for i in range(102, 114):
        run.feed(0, BLACK, at=i)
    assert run.until_found([(12 + i, None) for i in range(12)], at=114).in_map
    tracker = run.tracker
    before = tracker.last_pose().copy()
    keyframes = tracker.world.keyframes
    home = {k: f.world_from_camera.copy() for k, f in keyframes.items() if tracker.parts.of(k) == HOME}
    assert any(run.keyframes[k] > 113 for k in home), "one that the backend had not heard of"
    bring_home(run, motion)
    for k, pose in home.items():
        assert np.abs(se3_log(inverse(pose) @ keyframes[k].world_from_camera)).max() < 0.01
    assert np.abs(se3_log(inverse(before) @ tracker.last_pose())).max() < 0.01, "else odom would jump"


def test_what_a_part_had_mapped_is_found_again_once_it_is_home():
    """Points know from where, and from how far, they were seen: that is otherwise since."""
    shares = []
    for joined in (False, True):
        run, room = in_the_dark(20, 0.3), other_room(60)
        visit(run, room, at=32)
        world = run.tracker.world
        if joined:
            bring_home(run, pose_at(3.0, 0.5, -1.0, 0.0, 2.5, 0.0), size=0.6)
        before = world.points.ids[world.points.alive].copy()
        for i, (image, _, _) in enumerate(reversed(room), start=92):
            assert run.feed(0, image, at=i).world_from_camera is not None
        way_back = [k.points for k in world.keyframes.values() if k.index >= 92]
        seen = np.concatenate([points[points >= 0] for points in [*way_back, run.tracker.last.points]])
        shares.append(np.isin(seen, before).mean())
    assert shares[1] > (1.0 - 0.1 * SLACK) * shares[0]


def a_part_that_waits() -> tuple[Run, list, int]:
    """A camera in another room whose depth doesn't come, what it saw there, and the keyframe that waits."""
    run, room = in_the_dark(30, 0.3), other_room(30)
    for i, (image, _, _) in enumerate(room):
        assert run.feed(0, image, at=42 + i).world_from_camera is None
    waiting = max(run.tracker.world.keyframes)
    assert run.keyframes[waiting] >= 42
    return run, room, waiting


def test_without_depth_no_part_is_begun_in_vain():
    """Its first keyframe waits for depth; found in the old map meanwhile, it is forgotten."""
    run, _, waiting = a_part_that_waits()
    found = run.until_found([(20 + i, None) for i in range(8)], at=72)
    assert found.in_map
    assert waiting not in run.tracker.world.keyframes
    assert run.tracker.add_depth(waiting, footage().depths[0], IDENTITY, 0.1) == 0
    check(run.tracker.world)


def test_the_first_depth_of_a_part_is_put_into_the_unit_that_is_published():
    """Later ones are put there by the map's own, which may differ: a part begins in no map."""
    run = Run(Tracker(replace(CONFIG, submap_after_s=0.1, lost_after_s=0.0)))
    run.play(range(5), depth_for="first")
    tracker, image = run.tracker, churning(1)[0]
    depth = np.tile(np.linspace(1.0, 3.0, 320, dtype=np.float32), (240, 1))
    tracker.log_scale, tracker.map_log_scale = np.log(3.0), np.log(2.0)
    for i in range(5, 11):
        run.feed(0, image, at=i)
    waiting = tracker.world.newest()
    assert tracker.parts.of(waiting.id) == waiting.id
    assert tracker.add_depth(waiting.id, depth, IDENTITY, 0.1) > 50
    keypoints, depths = tracker.world.depths_in(waiting)
    x, y = np.rint(waiting.features.pixels[keypoints]).astype(int).T
    assert np.median(depth[y, x] / depths) == pytest.approx(3.0, rel=0.02)


def test_a_part_that_is_given_up_does_not_begin_once_its_depth_comes():
    run, room, waiting = a_part_that_waits()
    run.tracker.may_map = False
    run.tracker.give_up_waiting()
    assert run.tracker.add_depth(waiting, room[0][1], IDENTITY, 0.1) == 0
    assert run.feed(0, room[-1][0], at=72).odometry == LOST
    check(run.tracker.world)


def test_a_map_lost_before_it_is_firm_gives_way_to_a_new_one_from_where_the_camera_was():
    run, room = Run(), other_room()
    run.play(range(20))
    run.tracker.log_scale = 0.3  # as the scale process has found meanwhile
    last = run.tracker.last_pose()
    for i in range(20, 32):
        run.feed(0, BLACK, at=i)
    visit(run, room, at=32)
    first = next(i for i in range(32, 92) if run.results[i].world_from_camera is not None)
    assert 19 <= first - 32 <= 22, "looked for as long as it had been seen, 19 frames"
    assert [run.results[i].odometry for i in (31, first - 1, first)] == [LOST, INITIALISING, OK]
    assert run.tracker.epoch == 1
    assert run.tracker.log_scale == 0.0
    assert all(run.results[i].in_map for i in range(first, 92))
    begun = run.tracker.world.keyframes[min(run.tracker.world.keyframes)].world_from_camera
    assert begun == pytest.approx(scaled(last, np.exp(0.3)), abs=1e-9), "no jump to the origin"
    moved = inverse(begun) @ run.results[91].world_from_camera
    true = inverse(room[first - 1 - 32][2]) @ room[91 - 32][2]
    assert np.linalg.norm(moved[:3, 3] - true[:3, 3]) < 0.1 * np.linalg.norm(true[:3, 3]) + 0.02
    check(run.tracker.world)


def test_darkness_gives_no_map_up():
    run = Run()
    run.play(range(20))
    for i in range(20, 80):
        run.feed(0, BLACK, at=i)
    found = run.until_found([(20 + i, None) for i in range(6)], at=80)
    assert run.tracker.epoch == 0
    assert np.linalg.norm((found.world_from_camera - footage().poses[20 + run.found_at - 80])[:3, 3]) < 0.03


def test_one_that_never_maps_on_its_own_gives_none_up_either():
    run, room = Run(tracker=Tracker(replace(CONFIG, submap_after_s=0.0))), other_room()
    run.play(range(20))
    for i, (image, _, _) in enumerate(room):
        run.feed(0, image, at=20 + i)
    assert run.tracker.epoch == 0
    assert run.results[79].odometry == LOST


def churning(count: int) -> list[np.ndarray]:
    """Images that show much, and nothing twice: foliage in the wind, water, a screen."""
    rng = np.random.default_rng(0)
    small = [np.clip(rng.normal(128, 60, (60, 80)), 0, 255).astype(np.uint8) for _ in range(count)]
    return [cv2.resize(image, (320, 240), interpolation=cv2.INTER_CUBIC) for image in small]


def test_what_can_not_be_tracked_adds_no_keyframe_for_each_look_at_it():
    run = Run(tracker=Tracker(replace(CONFIG, submap_after_s=0.3)))
    run.play(range(30))
    world, tracker = run.tracker.world, run.tracker
    home = set(world.keyframes)
    keyframe_message(tracker, world.newest())
    begun, culled = [], []
    for i, image in enumerate(churning(100), start=30):
        known = set(run.keyframes)
        run.feed(0, image, at=i)
        for k in set(run.keyframes) - known:
            begun.append(k)
            culled.append(keyframe_message(tracker, world.keyframes[k]).culled_keyframes.tolist())
            tracker.recognise(k, np.eye(200, dtype=np.float32)[k])
            tracker.add_depth(k, footage().depths[0], IDENTITY, 0.1)
        assert home <= world.keyframes.keys()
        assert len(world.keyframes) <= len(home) + 1
    assert len(begun) >= 4, "each was tracked for a moment, and lost"
    assert culled == [[], *([k] for k in begun[:-1])], "the backend hears of each with the next"
    assert len(tracker.places.index) == 1
    check(world)
    found = run.until_found([(20 + i, None) for i in range(12)], at=130)
    assert found.in_map


def test_a_map_with_many_too_many_loses_some_where_a_part_begins():
    config = replace(CONFIG, submap_after_s=0.3, max_keyframes=20)
    tracker, world = Tracker(config), walk(40, 0.2)
    tracker.adopt(world, PlaceIndex(), Parts(), 0, 0.0)
    run = Run(tracker=tracker)
    for i, image in enumerate(churning(15)):
        run.feed(0, image, at=i)
    (begun,) = run.keyframes
    assert begun in world.keyframes
    assert len(world.keyframes) == 41 - AT_ONCE
    check(world)


def test_while_a_keyframe_joins_the_map_no_part_begins():
    """What the keyframe is told to share points with could leave the map."""
    run = Run(tracker=Tracker(replace(CONFIG, submap_after_s=0.1, lost_after_s=0.0)))
    run.play(range(20))
    tracker, film, later = run.tracker, footage(), iter(enumerate(churning(60), start=75))
    waiting = []

    def meanwhile() -> None:
        for _ in range(3):
            at, image = next(later)
            tracker.process(at, film.stamp_ns(at), image, film.camera)
            waiting.append(tracker.maybe_keyframe(judge=False))

    for i in range(20, 75):
        tracker.process(i, film.stamp_ns(i), film.images[i], film.camera)
        keyframe = tracker.maybe_keyframe()
        if keyframe is not None:
            break
    assert tracker.map_keyframe(meanwhile)
    assert len(waiting) > 6
    assert waiting == [None] * len(waiting)
    at, image = next(later)
    tracker.process(at, film.stamp_ns(at), image, film.camera)
    assert tracker.maybe_keyframe() is not None, "but then"


def test_a_minute_without_frames_was_not_spent_looking_about():
    """Lost, one frame, and the next a minute later: nothing has been looked for yet."""
    run, room = Run(), other_room()
    run.play(range(30))
    rate = round(1e9 / (footage().stamp_ns(1) - footage().stamp_ns(0)))
    for i in range(30, 45):
        run.feed(0, BLACK, at=i)
    keyframes = set(run.tracker.world.keyframes)
    for at in (45, 46, 46 + 60 * rate):
        run.feed(0, room[0][0], at=at)
    assert run.results[46 + 60 * rate].odometry == LOST
    assert run.tracker.epoch == 0
    assert set(run.tracker.world.keyframes) == keyframes
