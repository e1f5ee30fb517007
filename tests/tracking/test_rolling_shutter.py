"""Keypoints of a rolling shutter against a scene projected row by row from where the camera was."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from prism_edge.config import TrackingConfig
from prism_edge.geometry.cameras import PINHOLE, Camera
from prism_edge.geometry.poses import Array, inverse, rotation_angle, se3_exp, transform
from prism_edge.sources.base import Image
from prism_edge.sources.sim import SimSource
from prism_edge.tracking.announcement import keyframe_message
from prism_edge.tracking.features import Features
from prism_edge.tracking.frame_tracking import TrackedFrame
from prism_edge.tracking.local_map import LocalKeyframe, LocalMap
from prism_edge.tracking.orb_pyramid import Grey
from prism_edge.tracking.place_index import PlaceIndex
from prism_edge.tracking.rolling_shutter import RollingShutter, found_readout, see_at_once
from prism_edge.tracking.submaps import Parts
from prism_edge.tracking.tracker import Tracker
from prism_edge.tracking.view import View
from tests.synthetic.drawing import SLACK
from tests.synthetic.messages import map_update

CAMERA = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
READOUT_MS, DEPTH = 26.0, 2.0
FAST = "sim:room?seed=3&speed=1.2&readout=40&width=320&height=240&frames=14"


@cache
def drawn(world: str) -> tuple[SimSource, list[tuple[int, Grey]]]:
    """A simulated world, stamps and images: drawing row by row takes longer than tracking."""
    source = SimSource(world)
    source.open()
    images = [image for image in iter(source.read, None) if isinstance(image, Image)]
    return source, [(image.stamp_ns, image.pixels.mean(axis=2).astype(np.uint8)) for image in images]


def features(pixels: Array) -> Features:
    n = len(pixels)
    return Features.build(pixels, np.zeros(n, np.intp), np.zeros((n, 4), np.uint64), 640, 480)


def read_row_by_row(points: Array, twist: Array, camera: Camera, readout_s: float) -> Array:
    """Pixels of points (n, 3): each seen at the time when the row that it falls on is read."""
    pixels = camera.project(points)
    for _ in range(20):
        at, before = ((pixels[:, 1] + 0.5) / camera.height - 0.5) * readout_s, pixels
        seen = [transform(inverse(se3_exp(twist * t)), p[None]) for t, p in zip(at, points, strict=True)]
        pixels = camera.project(np.concatenate(seen))
        if np.abs(pixels - before).max() < 1e-9:
            break
    return pixels


def wall(seed: int) -> Array:
    """Points of a wall across the picture, and still in it when the camera has turned a little."""
    rng = np.random.default_rng(seed)
    pixels = rng.uniform((60, 60), (580, 420), (40, 2))
    return np.column_stack([(pixels - (319.5, 239.5)) / 525.0, np.ones(40)]) * DEPTH


@given(
    st.lists(st.floats(-0.6, 0.6), min_size=6, max_size=6),
    st.sampled_from([READOUT_MS, -READOUT_MS]),
    st.integers(0, 100),
)
def test_keypoints_go_where_the_middle_of_the_readout_has_them(
    moves: list[float], readout_ms: float, seed: int
) -> None:
    twist, points = np.array(moves), wall(seed)
    taken = read_row_by_row(points, twist, CAMERA, 1e-3 * readout_ms)
    seen = RollingShutter(readout_ms).in_the_middle(View(CAMERA, features(taken)), twist, DEPTH).features
    true = CAMERA.project(points)
    before, after = (np.abs(p - true).max() for p in (taken, seen.pixels))
    assert after < 0.02 + 0.05 * before  # what is left is of second order


def test_rows_are_the_lens_s() -> None:
    """A keypoint's time is that of the row where the image as taken has it, not of its ideal pixel."""
    bent = Camera(640, 480, 525.0, 525.0, 319.5, 239.5, distortion=(-0.3, 0.1, 0.0, 0.0))
    raw = np.array([[320.0, 450.0]])
    twist = np.array([0, 0, 0, 0, 0.5, 0])
    ideal = bent.undistort_pixels(raw)
    seen = RollingShutter(READOUT_MS).in_the_middle(View(bent, features(ideal)), twist, DEPTH).features
    late_s = ((450.0 + 0.5) / 480 - 0.5) * 1e-3 * READOUT_MS
    assert seen.pixels[0, 0] - ideal[0, 0] == pytest.approx(525.0 * 0.5 * late_s, rel=2e-3)


def test_a_global_shutter_and_a_camera_at_rest_change_nothing() -> None:
    view = View(CAMERA, features(CAMERA.project(wall(0))))
    assert RollingShutter(0.0).in_the_middle(view, np.ones(6), DEPTH) is view
    assert RollingShutter(READOUT_MS).in_the_middle(view, np.zeros(6), DEPTH) is view


def test_a_motion_that_is_wrong_by_far_leaves_numbers() -> None:
    found = features(CAMERA.project(wall(0)))
    seen = RollingShutter(100.0).in_the_middle(View(CAMERA, found), np.full(6, 1e4), DEPTH).features
    assert np.isfinite(seen.pixels).all()
    assert len(seen) == len(found)


def test_what_a_wrong_motion_would_put_behind_the_camera_stays_on_its_side() -> None:
    view, centre = View(CAMERA, features(CAMERA.project(wall(0)))), np.array([319.5, 239.5])
    seen = RollingShutter(100.0).in_the_middle(view, np.array([0, 0, 100.0, 0, 0, 0]), DEPTH).features
    assert ((seen.pixels - centre) * (view.features.pixels - centre) >= 0).all()


def two_views(twist: Array, elapsed_s: float) -> tuple[Features, Features, Array]:
    """A wall read row by row at two times, and where the middle of the second readout has it."""
    points, looks = wall(5), np.random.default_rng(5).integers(0, 2**63, (40, 4)).astype(np.uint64)
    before = transform(se3_exp(twist * elapsed_s), points)  # the camera was so far back
    taken = [read_row_by_row(p, twist, CAMERA, 1e-3 * READOUT_MS) for p in (before, points)]
    first, second = (Features.build(p, np.zeros(40, np.intp), looks, 640, 480) for p in taken)
    return first, second, CAMERA.project(points)


@pytest.mark.parametrize(
    ("twist", "left"),
    # A turn moves the rim more than the shift that it stands for.
    [((0, 0, 0, 0.1, 0.6, 0.2), 0.15), ((0.5, -0.3, 0, 0, 0, 0), 0.3)],
)
def test_where_a_map_begins_corners_say_how_the_camera_moves(twist: tuple[float, ...], left: float) -> None:
    first, second, true = two_views(np.array(twist), 0.033)
    shutter = RollingShutter(READOUT_MS)
    shutter.saw(View(CAMERA, first, 0))
    assert not shutter.may_begin
    shutter.saw(now := View(CAMERA, second, 33_000_000))
    assert shutter.may_begin
    seen = shutter.without_map(now).features.pixels
    before, after = (np.abs(p - true).max() for p in (second.pixels, seen))
    assert after < left * before


def test_two_frames_that_tell_no_motion_leave_what_begins_a_map() -> None:
    first, second, _ = two_views(np.array([0, 0, 0, 0, 0.6, 0]), 0.033)
    shutter, now = RollingShutter(READOUT_MS), View(CAMERA, second, 1_000_000_000)
    assert shutter.without_map(now) is now  # nothing came before it
    shutter.saw(View(CAMERA, first, 0))
    shutter.saw(now)
    assert shutter.without_map(now) is now  # a second apart
    shutter.saw(View(CAMERA, first, 1_033_000_000))
    shutter.saw(now := View(CAMERA, second, 1_033_000_000))
    assert shutter.without_map(now) is now  # at one time
    shutter.saw(View(CAMERA, features(first.pixels[:5]), 1_066_000_000))
    shutter.saw(now := View(CAMERA, second, 1_099_000_000))
    assert shutter.without_map(now) is now  # too few corners


def test_the_first_frame_of_all_stays_as_it_was_taken() -> None:
    shutter, first = RollingShutter(READOUT_MS), View(CAMERA, features(CAMERA.project(wall(0))))
    shutter.saw(first)
    assert shutter.without_map(first) is first


def test_a_global_shutter_begins_with_its_first_frame() -> None:
    view, shutter = View(CAMERA, features(CAMERA.project(wall(0)))), RollingShutter(0.0)
    shutter.saw(view)
    assert shutter.may_begin
    assert shutter.without_map(view) is view


def test_the_camera_says_the_readout_unless_it_is_set() -> None:
    view, twist = View(CAMERA, features(CAMERA.project(wall(0)))), np.array([0, 0, 0, 0.1, 0.5, 0])

    def moved(set_ms: float, camera_ms: float) -> Array:
        shutter = RollingShutter(set_ms)
        shutter.saw(view, camera_ms)
        return shutter.in_the_middle(view, twist, DEPTH).features.pixels

    by_hand = RollingShutter(READOUT_MS).in_the_middle(view, twist, DEPTH).features.pixels
    assert np.array_equal(moved(0.0, READOUT_MS), by_hand)
    assert np.array_equal(moved(READOUT_MS, 0.0), by_hand)
    assert np.array_equal(moved(READOUT_MS, -5.0), by_hand)
    assert np.array_equal(moved(0.0, 0.0), view.features.pixels)
    assert not np.allclose(by_hand, view.features.pixels, atol=0.5)


@pytest.mark.parametrize("lens", [0.0, 0.02])
def test_a_tracker_goes_by_the_camera_of_the_image_whatever_lens_is_found(lens: float) -> None:
    """The same path, to the bit, whether the camera or the configuration says it."""

    def path(set_ms: float, camera_ms: float) -> Array:
        tracker = Tracker(TrackingConfig(readout_ms=set_ms))
        source, images = drawn(FAST)
        camera = replace(source.camera, readout_ms=camera_ms)
        for index, (stamp_ns, grey) in enumerate(images):
            result = tracker.process(index, stamp_ns, grey, camera)
            keyframe = tracker.maybe_keyframe()
            tracker.map_keyframe()
            if keyframe is not None:
                tracker.add_depth(keyframe.id, source.depth(index), np.array([1.0, 0.0, 1.0, 0.0]), 0.01)
            if index == 6 and lens:
                found = Camera.from_array(PINHOLE, camera.bent(lens).to_array())
                tracker.apply_update(map_update(0, camera=found.to_array()))
        assert result.world_from_camera is not None
        return result.world_from_camera

    assert np.array_equal(path(0.0, 40.0), path(40.0, 0.0))
    assert not np.array_equal(path(0.0, 40.0), path(0.0, 0.0))


def turn_errors(readout_ms: float, way: str = "seed=3&speed=1.2") -> Array:
    """Errors (rad) of the turn over six frames of such a way."""
    tracker, estimated, true = Tracker(TrackingConfig(readout_ms=readout_ms)), [], []
    source, images = drawn(f"sim:room?{way}&readout=40&noise=0.5&blur=0&frames=60")
    for index, (stamp_ns, grey) in enumerate(images):
        result = tracker.process(index, stamp_ns, grey, source.camera)
        keyframe = tracker.maybe_keyframe()
        tracker.map_keyframe()
        if keyframe is not None:
            tracker.add_depth(keyframe.id, source.depth(index), np.array([1.0, 0.0, 1.0, 0.0]), 0.01)
        if result.world_from_camera is not None:
            estimated.append(result.world_from_camera)
            true.append(source.pose(index))
    assert len(estimated) > 50
    pairs = zip(estimated[:-6], estimated[6:], true[:-6], true[6:], strict=True)
    return np.array([
        rotation_angle((inverse(inverse(c) @ d) @ (inverse(a) @ b))[:3, :3]) for a, b, c, d in pairs
    ])


def test_a_walk_read_row_by_row_is_followed_better_when_that_is_known() -> None:
    said, unsaid, wrong = (np.sqrt(np.mean(turn_errors(ms) ** 2)) for ms in (40.0, 0.0, -40.0))
    assert said < 0.85 * unsaid
    assert unsaid < wrong


def test_a_turn_from_the_first_frame_on_is_followed_no_worse_when_that_is_known() -> None:
    said, unsaid = (np.sqrt(np.mean(turn_errors(ms, "seed=2&path=turn") ** 2)) for ms in (40.0, 0.0))
    assert said < 1.05 * SLACK * unsaid


def test_what_was_known_of_the_motion_before_a_long_gap_shears_no_image_after_it() -> None:
    """A camera that turned, was paused for a second, and stands."""
    tracker, pose = Tracker(TrackingConfig(readout_ms=30.0)), None
    with SimSource("sim:room?seed=3&speed=0.4&noise=0&blur=0&width=320&height=240&frames=14") as source:
        for index in range(source.frame_count):
            image = source.read()
            assert image is not None
            grey = image.pixels.mean(axis=2).astype(np.uint8)
            result = tracker.process(index, image.stamp_ns, grey, replace(source.camera, readout_ms=0.0))
            keyframe = tracker.maybe_keyframe()
            tracker.map_keyframe()
            if keyframe is not None:
                tracker.add_depth(keyframe.id, source.depth(index), np.array([1.0, 0.0, 1.0, 0.0]), 0.01)
        for still in range(1, 7):  # until the tracker has seen that it stands
            tracker.process(index + still, image.stamp_ns + 33_000_000 * still, grey, source.camera)
        assert tracker.last is not None
        pose = tracker.last.world_from_camera.copy()
        taken = tracker._extractor.extract(grey, source.camera)
        tracker.motion.twist = np.array([0, 0, 0, 0, 0.3, 0.0])
        result = tracker.process(index + 7, image.stamp_ns + 1_200_000_000, grey, source.camera)
    assert result.world_from_camera is not None
    assert np.array_equal(tracker.last.features.pixels, taken.pixels)
    off = inverse(pose) @ result.world_from_camera
    assert np.linalg.norm(off[:3, 3]) < 0.005
    assert rotation_angle(off[:3, :3]) < np.radians(0.1)


def test_what_was_found_counts_where_nobody_says_anything() -> None:
    view, shutter = View(CAMERA, features(CAMERA.project(wall(0)))), RollingShutter(0.0)
    for said_ms, counts, said in ((None, 26.0, False), (0.0, 0.0, True), (-9.0, -9.0, True)):
        shutter.saw(view, said_ms, 26.0)
        assert (shutter.readout_ms, shutter.is_said) == (counts, said)
        assert shutter.found_ms == (0.0 if said else counts)
    by_hand = RollingShutter(12.0)
    by_hand.saw(view, None, 26.0)
    assert (by_hand.readout_ms, by_hand.is_said) == (12.0, True)


def test_what_was_found_is_of_the_camera_that_made_the_map() -> None:
    """Not of one that is put in its place later, however much of the map that has made by then."""
    world, _ = local_world(np.array([0, 0, 0, 0.1, 0.5, 0]), 0.0)
    assert found_readout(world, CAMERA) == 0.0
    world.readout_ms = 26.0
    other = replace(CAMERA, width=2 * CAMERA.width)
    world.keyframes[7] = replace(world.newest(), id=7, camera=other)
    assert found_readout(world, CAMERA.bent(0.01)) == 26.0
    assert found_readout(world, other) == 0.0
    assert found_readout(LocalMap(26.0), other) == 26.0, "a map that has yet to begin, of the camera before"


@pytest.mark.parametrize("swapped", [False, True])
def test_a_camera_put_in_another_s_place_is_not_read_as_slowly(swapped: bool) -> None:
    tracker, (world, _) = Tracker(TrackingConfig()), local_world(np.zeros(6), 0.0)
    world.readout_ms = 26.0
    tracker.adopt(world, PlaceIndex(), Parts(), 1, 0.0)
    camera = replace(CAMERA, fx=1.5 * CAMERA.fx) if swapped else CAMERA
    tracker.process(0, 0, np.zeros((camera.height, camera.width), np.uint8), camera)
    assert tracker.shutter.readout_ms == (0.0 if swapped else 26.0)
    tracker.reset()
    assert tracker.world.readout_ms == tracker.shutter.readout_ms


def local_world(twist: Array, readout_s: float) -> tuple[LocalMap, Array]:
    """A keyframe that saw a wall row by row, in a map that has the wall; where it is in the middle."""
    world, points = LocalMap(), wall(2)
    taken = features(read_row_by_row(points, twist, CAMERA, readout_s))
    keyframe = LocalKeyframe(0, 0, 0, np.eye(4), CAMERA, taken, np.full(len(points), -1, np.int64))
    world.add_keyframe(keyframe)
    keypoints = np.arange(len(points))
    keyframe.points[:] = world.add_points(keyframe, keypoints, points, np.full(len(points), 0.1), 0.0)
    keyframe.twist = twist
    return world, CAMERA.project(points)


def test_keyframes_are_seen_at_once_as_far_as_a_readout_is_another_than_before() -> None:
    twist = np.array([0.4, 0.1, -0.2, 0.1, 0.5, 0.2])
    world, true = local_world(twist, 0.026)
    raw = world.keyframes[0].features.pixels
    for readout_ms in (16.0, 26.0):
        see_at_once(world, readout_ms, None, np.zeros(6), 0.0)
        assert world.readout_ms == readout_ms
    seen = world.keyframes[0].features
    assert np.abs(seen.pixels - true).max() < 0.02 + 0.05 * np.abs(raw - true).max()
    see_at_once(world, 26.0, None, np.zeros(6), 0.0)
    assert world.keyframes[0].features is seen, "no news"
    see_at_once(world, 0.0, None, np.zeros(6), 0.0)
    assert np.abs(world.keyframes[0].features.pixels - raw).max() < 0.05 * np.abs(raw - true).max()


def test_the_last_frame_is_seen_at_once_with_the_keyframes() -> None:
    """Else it would be held against them where it never was, and the step stay in `odom`."""
    twist = np.array([0.4, 0.1, -0.2, 0.1, 0.5, 0.2])
    world, true = local_world(twist, 0.026)
    keyframe = world.keyframes[0]
    raw, depth = keyframe.features, world.median_depth(keyframe)
    frame = TrackedFrame.of_keyframe(keyframe, len(raw))
    see_at_once(world, 26.0, frame, twist, depth)
    assert np.array_equal(frame.features.pixels, keyframe.features.pixels)
    assert np.abs(frame.features.pixels - true).max() < 0.02 + 0.05 * np.abs(raw.pixels - true).max()
    seen = frame.features
    see_at_once(world, 26.0, frame, twist, depth)
    assert frame.features is seen, "no news"
    see_at_once(world, 0.0, frame, np.zeros(6), depth)
    assert frame.features is seen, "a motion that nobody knows"


def test_a_keyframe_whose_motion_nobody_knows_stays_as_it_was_taken() -> None:
    world, _ = local_world(np.zeros(6), 0.026)
    before = world.keyframes[0].features
    see_at_once(world, 26.0, None, np.zeros(6), 0.0)
    assert world.keyframes[0].features is before


def test_a_tracker_takes_a_readout_out_that_the_backend_has_found(monkeypatch: pytest.MonkeyPatch) -> None:
    tracker, taken, told = Tracker(TrackingConfig()), [], []
    extract = tracker._extractor.extract

    def noted(grey: Any, camera: Camera) -> Features:
        taken.append(extract(grey, camera))
        return taken[-1]

    monkeypatch.setattr(tracker._extractor, "extract", noted)
    source, images = drawn(FAST)
    for index, (stamp_ns, grey) in enumerate(images):
        tracker.process(index, stamp_ns, grey, source.camera)
        keyframe = tracker.maybe_keyframe()
        tracker.map_keyframe()
        if keyframe is not None:
            tracker.add_depth(keyframe.id, source.depth(index), np.array([1.0, 0.0, 1.0, 0.0]), 0.01)
            message = keyframe_message(tracker, keyframe)
            assert (message.readout_ms, message.readout_said) == (40.0 if index > 6 else 0.0, False)
            told.append(message.readout_ms)
        if index == 1:
            assert tracker.last is not None
            assert tracker.last.features is taken[-1]
        if index == 6:
            tracker.apply_update(map_update(0, readout_ms=40.0))
            assert tracker.last is not None
            assert tracker.last.features is not taken[-1], "the last frame's keypoints are moved, too"
    assert tracker.last is not None
    assert len(tracker.last.features) == len(taken[-1])
    assert np.abs(tracker.last.features.pixels - taken[-1].pixels).max() > 1.0
    assert set(told) == {0.0, 40.0}
    tracker.reset()
    tracker.process(index + 1, stamp_ns + 33_000_000, grey, source.camera)
    assert tracker.shutter.readout_ms == 40.0, "another map is by the same camera"


def test_a_keyframe_says_whether_its_camera_does() -> None:
    for said_ms, told in ((None, (0.0, False)), (0.0, (0.0, True)), (12.0, (12.0, True))):
        tracker = Tracker(TrackingConfig())
        source, images = drawn(FAST)
        camera = replace(source.camera, readout_ms=said_ms)
        for index, (stamp_ns, grey) in enumerate(images):
            tracker.process(index, stamp_ns, grey, camera)
            if (keyframe := tracker.maybe_keyframe()) is not None:
                break
        assert keyframe is not None
        message = keyframe_message(tracker, keyframe)
        assert (message.readout_ms, message.readout_said) == told
