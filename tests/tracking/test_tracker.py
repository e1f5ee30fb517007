"""The tracker on a generated film: what it gives, against the truth; what it does when it can't see."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import cv2
import numpy as np
import pytest

from prism_edge.config import TrackingConfig
from prism_edge.geometry.poses import inverse, se3_log, transform
from prism_edge.messages import DEGRADED, INITIALISING, LOST, OK
from prism_edge.tracking.announcement import keyframe_message
from prism_edge.tracking.tracker import FrameResult, Tracker
from tests.synthetic.scene import block_texture
from tests.tracking.cloud import check, map_update, pose_at
from tests.tracking.footage import IDENTITY, RATE_HZ, footage, other_room

CONFIG = TrackingConfig(features=500, max_features=500)
BLACK = np.zeros((240, 320), np.uint8)


@dataclass
class Run:
    """A tracker and what it said."""

    tracker: Tracker = field(default_factory=lambda: Tracker(CONFIG))
    results: dict[int, FrameResult] = field(default_factory=dict)
    keyframes: dict[int, int] = field(default_factory=dict)  # id: frame
    found_at: int = -1

    def feed(self, index: int, image: np.ndarray | None = None, at: int | None = None) -> FrameResult:
        """Frame ``index`` of the film (or another image) as frame ``at``."""
        film = footage()
        at = index if at is None else at
        image = film.images[index] if image is None else image
        result = self.tracker.process(at, film.stamp_ns(at), image, film.camera)
        self.results[at] = result
        keyframe = self.tracker.maybe_keyframe()
        if keyframe is not None:
            self.keyframes[keyframe.id] = at
        return result

    def until_found(self, views: list[tuple[int, np.ndarray | None]], at: int) -> FrameResult:
        """Feed one view after the other; the first that is placed, which is ``found_at``."""
        for i, (index, image) in enumerate(views):
            result = self.feed(index, image, at=at + i)
            if result.world_from_camera is not None:
                self.found_at = at + i
                return result
        raise AssertionError("it was not found")

    def depth(self, keyframe: int, of: int | None = None, factor: float = 1.0) -> int:
        """The film's own depth of a keyframe."""
        frame = self.keyframes[keyframe] if of is None else of
        return self.tracker.add_depth(keyframe, factor * footage().depths[frame], IDENTITY, 0.1)

    def play(self, frames: range, depth_for: str = "all") -> None:
        for i in frames:
            known = set(self.keyframes)
            self.feed(i)
            for k in set(self.keyframes) - known:
                if depth_for == "all" or (depth_for == "first" and k == 0):
                    self.depth(k)

    def errors(self, frames: range) -> np.ndarray:
        """Distance (m) of each published pose from the truth, in the frame of the first image."""
        poses = footage().poses
        return np.array(
            [np.linalg.norm((self.results[i].world_from_camera - poses[i])[:3, 3]) for i in frames]
        )


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


def test_it_goes_on_when_nobody_answers_after_the_start():
    run = Run()
    run.play(range(75), depth_for="first")
    assert all(run.results[i].odometry == OK for i in range(1, 75))
    assert run.errors(range(1, 75)).max() < 0.06
    assert len(run.keyframes) >= 2


def test_a_camera_that_sees_nothing_is_lost_and_found_again():
    run = Run()
    run.play(range(30))
    before = run.results[29].world_from_camera
    words = [run.feed(0, BLACK, at=i).odometry for i in range(30, 45)]
    soon = round(CONFIG.lost_after_s * RATE_HZ)
    assert words[: soon - 1] == [DEGRADED] * (soon - 1)
    assert words[soon:] == [LOST] * (15 - soon)
    assert all(run.results[i].world_from_camera is None for i in range(30, 45))
    keyframes = len(run.keyframes)
    # Held still meanwhile, the camera is found at once; not as a jump, and in the same map.
    assert run.feed(30, at=45).odometry == LOST, "one frame is not believed"
    found = run.feed(31, at=46)
    assert found.odometry in (OK, DEGRADED)
    assert np.linalg.norm((found.world_from_camera - before)[:3, 3]) < 0.05
    assert run.tracker.epoch == 0
    for i in range(47, 60):
        assert run.feed(i - 15, at=i).odometry == OK
    error = np.linalg.norm((run.results[59].world_from_camera - footage().poses[44])[:3, 3])
    assert error < 0.04
    assert len(run.keyframes) >= keyframes


def test_it_is_found_where_it_was_carried_in_the_dark():
    run = Run()
    run.play(range(30))
    for i in range(30, 45):
        run.feed(0, BLACK, at=i)
    # It comes back at frame 12, which is neither where it was lost nor where it was heading.
    found = run.until_found([(12 + i, None) for i in range(4)], at=45)
    off = found.world_from_camera - footage().poses[12 + run.found_at - 45]
    assert np.linalg.norm(off[:3, 3]) < 0.03


def rolled(index: int, angle: float) -> tuple[np.ndarray, np.ndarray]:
    """A frame as a camera turned about its axis sees it, and where that camera is."""
    film = footage()
    c, s = np.cos(angle), np.sin(angle)
    turn, centre = np.array([[c, -s], [s, c]]), np.array([film.camera.cx, film.camera.cy])
    from_new = np.column_stack([turn, centre - turn @ centre])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpAffine(film.images[index], from_new, (320, 240), flags=flags), film.poses[index] @ pose_at(
        0, 0, 0, 0, 0, angle
    )


def test_it_is_found_where_no_search_near_the_last_place_reaches():
    run = Run()
    run.play(range(30))
    for i in range(30, 45):
        run.feed(0, BLACK, at=i)
    turned = [rolled(20 + i, 2.5) for i in range(8)]
    found = run.until_found([(20 + i, image) for i, (image, _) in enumerate(turned)], at=45)
    assert np.linalg.norm((found.world_from_camera - turned[run.found_at - 45][1])[:3, 3]) < 0.04


def test_another_room_is_not_taken_for_this_one():
    run = Run()
    run.play(range(30))
    elsewhere = block_texture(np.random.default_rng(7), 320, 240)
    for i in range(30, 45):
        assert run.feed(0, elsewhere, at=i).world_from_camera is None


def test_a_gap_in_the_frames_is_bridged():
    run = Run()
    run.play(range(20))
    assert run.feed(30).odometry == OK
    assert run.errors(range(30, 31))[0] < 0.03


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


@pytest.fixture(scope="module")
def astray() -> tuple[Run, list]:
    """A camera that was carried to another room, and maps there."""
    run, room = Run(tracker=Tracker(replace(CONFIG, submap_after_s=0.4))), other_room()
    run.play(range(30))
    for i in range(30, 42):
        run.feed(0, BLACK, at=i)
    for i, (image, depth, _) in enumerate(room):
        run.feed(0, image, at=42 + i)
        for k, frame in run.keyframes.items():
            if frame == 42 + i:
                run.tracker.add_depth(k, depth, IDENTITY, 0.1)
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


def test_a_loop_between_the_parts_brings_the_camera_home():
    run, room = Run(tracker=Tracker(replace(CONFIG, submap_after_s=0.3))), other_room(40)
    run.play(range(20))
    for i in range(20, 32):
        run.feed(0, BLACK, at=i)
    for i, (image, depth, _) in enumerate(room):
        run.feed(0, image, at=32 + i)
        for k, frame in run.keyframes.items():
            if frame == 32 + i:
                run.tracker.add_depth(k, depth, IDENTITY, 0.1)
    last = run.results[71]
    assert not last.in_map
    world, motion = run.tracker.world, pose_at(3.0, 0.5, -1.0, 0.2, 0.7, -0.1)
    mine = sorted(k for k in world.keyframes if run.tracker.parts.of(k) >= 0)
    ids = np.unique(np.concatenate([world.keyframes[k].points for k in mine]))
    ids = ids[ids >= 0]
    run.tracker.apply_update(
        replace(
            map_update(
                mine[-1],
                keyframes=np.array(mine),
                poses=np.array([motion @ world.keyframes[k].world_from_camera for k in mine]),
                points=ids,
                positions=transform(motion, world.points.position[world.points.rows(ids)]),
                parallax_deg=np.zeros(len(ids), np.float32),
            ),
            loop_query=mine[-1],
            loop_candidate=0,
        )
    )
    after = run.feed(0, room[-1][0], at=72)
    assert after.in_map
    off = inverse(motion @ last.world_from_camera) @ after.world_from_camera
    assert np.abs(se3_log(off)).max() < 0.02


def test_without_depth_no_part_is_begun_in_vain():
    """Its first keyframe waits for depth; found in the old map meanwhile, it is forgotten."""
    run, room = Run(tracker=Tracker(replace(CONFIG, submap_after_s=0.3))), other_room(30)
    run.play(range(30))
    for i in range(30, 42):
        run.feed(0, BLACK, at=i)
    for i, (image, _, _) in enumerate(room):
        assert run.feed(0, image, at=42 + i).world_from_camera is None
    waiting = max(run.tracker.world.keyframes)
    assert run.keyframes[waiting] >= 42
    found = run.until_found([(20 + i, None) for i in range(8)], at=72)
    assert found.in_map
    assert waiting not in run.tracker.world.keyframes
    assert run.tracker.add_depth(waiting, footage().depths[0], IDENTITY, 0.1) == 0
    check(run.tracker.world)
