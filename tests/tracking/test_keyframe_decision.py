"""When a frame becomes a keyframe, and when an older one does as well."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from prism_edge.config import TrackingConfig
from prism_edge.tracking.features import Features
from prism_edge.tracking.frame_tracking import TrackedFrame
from prism_edge.tracking.keyframe_decision import (
    KNOWN_S,
    RECENT,
    SAME_SHARE,
    decide,
    is_overdue,
    same_view,
    shown_before,
    uncovered_share,
)
from prism_edge.tracking.local_map import LocalMap
from tests.tracking.cloud import CAMERA, Cloud, pose_at

CONFIG = TrackingConfig()


@pytest.fixture
def reference():
    return Cloud(300).keyframe(0, np.eye(4))[0]


def frame_at(pose, matched=200, covered=True) -> TrackedFrame:
    rng = np.random.default_rng(0)
    pixels = rng.uniform((0, 0), (640, 480), (600, 2))
    words = np.zeros((600, 4), np.uint64)
    features = Features.build(pixels, np.zeros(600, np.intp), words, 640, 480)
    points = np.where((pixels[:, 0] < 640 if covered else pixels[:, 0] < 300), 7, -1)
    return TrackedFrame(CAMERA, features, pose, points, np.zeros((6, 6)), matched)


def judge(frame, reference, seconds=0.5, reference_matches=200, depth=3.0, config=CONFIG):
    return decide(config, frame, reference, seconds, reference_matches, depth)


@pytest.mark.parametrize(
    ("frame", "seconds", "reason"),
    [
        (frame_at(pose_at(0.1), matched=150), 0.5, "few matches"),
        (frame_at(pose_at(0.3)), 0.5, "baseline"),
        (frame_at(pose_at(0.1)), 2.0, "time"),
        (frame_at(pose_at(0.1), covered=False), 0.5, "new ground"),
        (frame_at(pose_at(0, 0, 0, 0, 0.1), matched=100), 0.5, "few matches"),
        (frame_at(pose_at(0.1), matched=119), 0.06, "few matches"),  # so few can't wait
        (frame_at(pose_at(0, 0, 0, 0, 0.1)), 2.0, "time"),
        (frame_at(pose_at(0.031), matched=50), 0.5, "few matches"),  # a hundredth of the depth, 3
        (frame_at(pose_at(0, 0, 0, 0, np.radians(2.1)), matched=50), 0.5, "few matches"),
    ],
)
def test_reasons(reference, frame, seconds, reason):
    assert judge(frame, reference, seconds) == reason


@pytest.mark.parametrize(
    ("frame", "seconds"),
    [
        (frame_at(pose_at(0.1)), 0.5),  # nothing new
        (frame_at(pose_at(0.3), matched=150), 0.1),  # too soon
        (frame_at(pose_at(0.3), matched=119), 0.04),  # and so it is for any
        (frame_at(pose_at(0.029), matched=50, covered=False), 60.0),  # has not moved
        (frame_at(pose_at(0, 0, 0, 0, np.radians(1.9)), matched=50), 60.0),  # hardly turned
    ],
)
def test_no_reason(reference, frame, seconds):
    assert not judge(frame, reference, seconds)


def test_where_there_was_never_more_to_match_it_still_is_little(reference):
    assert judge(frame_at(pose_at(0.1), matched=119), reference, reference_matches=119) == "few matches"
    assert not judge(frame_at(pose_at(0.1), matched=120), reference, reference_matches=120)


def test_a_baseline_counts_relative_to_the_depth(reference):
    near, far = frame_at(pose_at(0.3)), frame_at(pose_at(0.3))
    assert judge(near, reference, depth=3.0)
    assert not judge(far, reference, depth=6.0)


def test_motion_is_relative_to_the_reference(reference):
    away = replace(reference, world_from_camera=pose_at(5.0, 2.0, 1.0, 0.3, 0.2, 0.1))
    still = frame_at(away.world_from_camera @ pose_at(0.01))
    assert not judge(still, away, seconds=60.0)
    assert judge(frame_at(np.eye(4)), away)


def test_the_configuration_is_heeded(reference):
    assert judge(
        frame_at(pose_at(0.1)), reference, seconds=0.5, config=replace(CONFIG, keyframe_max_s=0.4)
    )
    assert not judge(
        frame_at(pose_at(0.3)), reference, seconds=0.5, config=replace(CONFIG, keyframe_min_s=0.6)
    )
    assert not judge(
        frame_at(pose_at(0.1), matched=150), reference, config=replace(CONFIG, keyframe_ratio=0.5)
    )


def test_uncovered_share_counts_textured_cells_without_points():
    frame = frame_at(np.eye(4), covered=False)
    pixels, points = frame.features.pixels, frame.points
    textured, bare = 0, 0
    for x in range(10):
        for y in range(8):
            mine = np.all(pixels // 64 == (x, y), axis=1)
            if mine.sum() >= 3:
                textured += 1
                bare += not (points[mine] >= 0).any()
    assert uncovered_share(frame) == pytest.approx(bare / textured)
    assert uncovered_share(frame_at(np.eye(4))) == 0.0


def test_corners_that_a_lens_has_put_outside_count_with_those_at_the_border():
    """Undistorted, they may lie anywhere about the image: in the cells of its border."""
    left = [[-70.0, 10.0], [-3.0, -50.0], [5.0, -1.0]]
    outside = np.array([*left, [720.0, 300.0], [1e4, 300.0], [660.0, 280.0]])
    words, octaves = np.zeros((6, 4), np.uint64), np.zeros(6, np.intp)
    features = Features.build(outside, octaves, words, 640, 480)
    for points, share in (([7, -1, -1, -1, -1, -1], 0.5), ([-1, -1, 7, -1, 7, -1], 0.0)):
        frame = replace(frame_at(np.eye(4)), features=features, points=np.array(points))
        assert uncovered_share(frame) == share


def test_an_image_without_corners_is_not_new_ground():
    frame = frame_at(np.eye(4))
    none = Features.build(np.zeros((0, 2)), np.zeros(0, np.intp), np.zeros((0, 4), np.uint64), 640, 480)
    assert uncovered_share(replace(frame, features=none, points=np.zeros(0, np.int64))) == 0.0


PLACES = [pose_at(0.3 * i, 0.0, 0.0, 0.0, -0.05 * i) for i in range(4)]


@pytest.fixture(scope="module")
def returned() -> tuple[Cloud, LocalMap]:
    """A map of four places and of the newest keyframes, which are all elsewhere."""
    cloud = Cloud(600)
    world, _ = cloud.mapped(PLACES + [pose_at(-0.5, -0.02 * i) for i in range(RECENT)])
    return cloud, world


def placed(cloud: Cloud, world: LocalMap, pose: np.ndarray, share: float = 1.0) -> TrackedFrame:
    """A frame that has found a share of the points that it sees."""
    features, shown = cloud.view(pose)
    of_cloud = {tuple(words): i for i, words in enumerate(cloud.descriptors.tolist())}
    table = world.points
    ids = {of_cloud[tuple(w)]: i for i, w in zip(table.ids.tolist(), table.descriptor.tolist(), strict=True)}
    points = np.array([ids.get(i, -1) for i in shown.tolist()])
    points[int(share * len(points)) :] = -1
    return TrackedFrame(CAMERA, features, pose, points, np.zeros((6, 6)), int((points >= 0).sum()))


@pytest.mark.parametrize("place", range(4))
def test_a_known_place_is_the_nearest_keyframe_s(returned, place):
    cloud, world = returned
    frame = placed(cloud, world, PLACES[place] @ pose_at(0.05, 0.03, 0.0, 0.0, 0.03))
    known = shown_before(world, frame, 4.0)
    assert known is world.keyframes[place]
    assert shown_before(world, frame, 1.0) is None  # 6 cm are far where all is near


def test_of_two_that_are_near_enough_it_is_the_nearer(returned):
    cloud, _ = returned
    for places in ([0.0, 0.1], [0.1, 0.0]):
        world, _ = cloud.mapped([pose_at(x) for x in [*places, *(3.0 + np.arange(RECENT))]])
        frame = placed(cloud, world, pose_at(0.08))
        assert shown_before(world, frame, 4.0) is world.keyframes[places.index(0.1)]


@pytest.mark.parametrize(
    ("motion", "share"),
    [
        (pose_at(0.15, 0.15), 1.0),  # between two places
        (pose_at(0.0, 0.0, 0.0, 0.0, 0.1), 1.0),  # the same place, another view
        (pose_at(0.01), 0.3),  # what was seen there is no longer
    ],
)
def test_what_no_keyframe_shows_is_no_known_place(returned, motion, share):
    cloud, world = returned
    frame = placed(cloud, world, PLACES[1] @ motion, share)
    assert shown_before(world, frame, 4.0) is None


def test_a_frame_that_matches_little_needs_a_keyframe_of_its_own(returned):
    cloud, world = returned
    frame = placed(cloud, world, PLACES[1])
    assert shown_before(world, replace(frame, matched=119), 4.0) is None


def test_the_newest_are_no_known_place(returned):
    cloud, world = returned
    frame = placed(cloud, world, world.newest().world_from_camera)
    assert frame.matched >= 120
    assert shown_before(world, frame, 4.0) is None
    assert shown_before(LocalMap(), frame, 4.0) is None
    young, _ = cloud.mapped([frame.world_from_camera] * RECENT)
    assert shown_before(young, frame, 4.0) is None


@pytest.mark.parametrize("sign", [1, -1])
def test_now_and_then_a_known_place_makes_a_keyframe(returned, sign):
    """What is heard of depth, scale and loops comes with keyframes; and a clock may be set back."""
    _, world = returned
    newest_ns = world.newest().stamp_ns
    for seconds, overdue in ((0.9 * KNOWN_S, False), (1.1 * KNOWN_S, True)):
        assert is_overdue(world, newest_ns + sign * int(1e9 * seconds)) is overdue


@pytest.mark.parametrize(("share", "newer", "known"), [(0.6, 1000, True), (0.3, 0, False), (1.0, 5000, True)])
def test_the_share_is_of_what_the_keyframe_sees(share: float, newer: int, known: bool) -> None:
    world, _ = Cloud(600).mapped([pose_at(0.3 * i) for i in range(RECENT + 1)])
    keyframe = world.keyframes[0]
    mine = keyframe.points[keyframe.observed()]
    seen = np.concatenate([mine[: int(share * len(mine))], 10**6 + np.arange(newer)])
    assert (same_view([keyframe], keyframe.world_from_camera, seen, 4.0) is keyframe) == known
    assert (share >= SAME_SHARE) == known
