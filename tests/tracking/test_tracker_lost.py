"""A tracker that no longer sees its map: when it says so, and that it is found again, in the right place."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from prism_edge.geometry.poses import inverse
from prism_edge.messages import DEGRADED, LOST, OK
from prism_edge.tracking import tracker as tracking
from prism_edge.tracking.frame_tracking import FrameTracker
from prism_edge.tracking.submaps import HOME, Parts
from tests.synthetic.scene import block_texture
from tests.tracking.cloud import pose_at
from tests.tracking.film_run import BLACK, CONFIG, Run
from tests.tracking.footage import RATE_HZ, footage


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


def test_the_looks_of_a_lost_camera_say_nothing_against_points():
    """Else the more often it looks at a wrong place, the less is missed there."""
    run = Run()
    run.play(range(30))
    for i in range(30, 45):
        run.feed(0, BLACK, at=i)
    table = run.tracker.world.points
    visible, found = table.visible.copy(), table.found.copy()
    assert run.feed(30, at=45).odometry == LOST, "it was looked for, and one look is not believed"
    assert run.tracker.places._tentative is not None
    assert np.array_equal(table.visible, visible)
    assert np.array_equal(table.found, found)
    run.feed(31, at=46)
    run.feed(32, at=47)
    assert (run.tracker.world.points.visible[: len(visible)] > visible).any(), "found, it learns again"


@pytest.mark.parametrize("gap_s", [0.5, 2.0])
def test_after_a_pause_in_the_images_one_look_is_not_believed(gap_s):
    """It may have been carried meanwhile, and a few points fit in many a place."""
    run, since_ns = Run(), round(gap_s * 1e9)
    run.play(range(30))
    film, track = footage(), run.tracker.process
    stamp_ns = film.stamp_ns(29) + since_ns
    lapsed = gap_s > 0.6
    first = track(30, stamp_ns, film.images[30], film.camera, since_ns)
    assert (first.odometry == LOST) == lapsed
    assert (first.world_from_camera is None) == lapsed
    second = track(31, stamp_ns + since_ns // 20, film.images[31], film.camera, since_ns // 20)
    assert second.odometry in (OK, DEGRADED)
    assert np.linalg.norm((second.world_from_camera - film.poses[31])[:3, 3]) < 0.04
    assert run.tracker.epoch == 0


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


def test_a_map_of_an_earlier_run_is_not_given_up_however_briefly_it_was_seen():
    """One that was just begun would be, with a new one from where the camera was."""
    before, run = Run(), Run()
    before.play(range(30))
    world = before.tracker.world
    run.tracker.adopt(world, before.tracker.places.index, Parts(), 1000, 0.0)
    run.until_found([(i, None) for i in range(20, 30)], at=0)
    elsewhere = block_texture(np.random.default_rng(7), 320, 240)
    after = run.found_at + 1
    for i in range(after, after + 45):
        assert run.feed(0, elsewhere, at=i).world_from_camera is None
    assert run.results[after + 44].odometry == LOST
    assert (run.tracker.world, run.tracker.epoch) == (world, 1000)


def test_who_is_found_in_another_part_hangs_on_a_keyframe_of_that_part():
    """The one that it was at before is in a part whose place is unknown."""
    run = Run()
    run.play(range(50))
    tracker, part = run.tracker, sorted(run.keyframes)[-2:]
    tracker.parts = Parts.given(dict.fromkeys(part, part[0]))
    tracker.parts.current = part[0]
    tracker._at.move_to(tracker.world.keyframes[part[0]], tracker.world, tracker.parts, 0)
    for i in range(50, 65):
        run.feed(0, BLACK, at=i)
    found = run.until_found([(3 + i, None) for i in range(6)], at=65)
    assert found.in_map
    assert tracker.parts.of(found.reference) == HOME
    carried = tracker.world.keyframes[found.reference].world_from_camera @ found.reference_from_camera
    assert np.allclose(carried, found.world_from_camera, atol=1e-9)


def test_a_camera_that_is_not_found_gets_more_features_until_it_is():
    run = Run(tracking.Tracker(replace(CONFIG, features=300, max_features=600)))
    run.play(range(10), depth_for="first")
    before = len(run.tracker.last.features)
    assert before < 500, "most match, so fewer are enough"
    for i in range(10, 13):
        assert run.feed(0, BLACK, at=i).odometry == DEGRADED
    assert run.feed(10, at=13).odometry == OK
    assert len(run.tracker.last.features) > 1.1 * before


@pytest.mark.parametrize("then", [12, 14])
def test_after_a_frame_that_was_not_found_the_camera_may_have_gone_on_or_stand(monkeypatch, then):
    """A hand before the lens stops no camera, a blow may: it is found either way."""
    run, expected = Run(), []
    run.play(range(12), depth_for="first")
    follow = FrameTracker.track_after

    def followed(self, world, view, moving, *rest):
        expected.append(moving)
        return follow(self, world, view, moving, *rest)

    monkeypatch.setattr(FrameTracker, "track_after", followed)
    run.feed(12)
    at_12 = run.tracker.last_pose()
    assert run.feed(0, BLACK, at=13).world_from_camera is None
    assert run.feed(then, at=14).odometry == OK
    truth = footage().poses
    step, true = inverse(at_12) @ expected[-1], inverse(truth[12]) @ truth[14]
    assert np.linalg.norm((step - true)[:3, 3]) < 0.5 * np.linalg.norm(true[:3, 3])
    assert run.errors(range(12, 13))[0] < 0.02
    assert np.linalg.norm((run.results[14].world_from_camera - truth[then])[:3, 3]) < 0.02


@pytest.mark.parametrize("missing", [0, 1])
def test_a_frame_that_fewer_points_agree_on_than_are_needed_is_not_believed(missing, monkeypatch):
    """Where nothing else is found either; as many as are needed are enough."""
    run = Run()
    run.play(range(4), depth_for="first")
    follow, matched = FrameTracker.track_after, CONFIG.min_matches - missing
    monkeypatch.setattr(FrameTracker, "track_after", lambda *of: replace(follow(*of), matched=matched))
    monkeypatch.setattr(tracking, "recover", lambda *_: None)
    monkeypatch.setattr(tracking, "look_again", lambda world, parts, frames, frame, *_: frame)
    assert (run.feed(4).world_from_camera is None) == bool(missing)
