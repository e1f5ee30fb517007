"""A camera that only turns: its orientation is measured, and its translation says that it isn't."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from prism_edge.config import TrackingConfig
from prism_edge.geometry.poses import from_rt, inverse, rotation_angle, so3_exp
from prism_edge.messages import OK
from prism_edge.tracking import baseline
from prism_edge.tracking.baseline import (
    LEAST_PARALLAX_DEG,
    UNOBSERVED,
    Baselines,
    best_parallax,
    unobserved_translation,
)
from prism_edge.tracking.local_map import LocalMap
from prism_edge.tracking.point_table import PointTable
from prism_edge.tracking.tracker import FrameResult, Tracker
from prism_edge.tracking.view import View
from tests.synthetic.render import Renderer
from tests.synthetic.scene import furnished_room, hand_held_path
from tests.synthetic.sequence import synthetic_camera
from tests.tracking.footage import IDENTITY, RATE_HZ, footage, other_room
from tests.tracking.test_tracker_parts import in_the_dark

TURNING, MOVING = 45, 25
CONFIG = TrackingConfig(features=500)


def path() -> list[np.ndarray]:
    """A degree a frame to the right on the spot, then sideways by 2 cm a frame."""
    begin = hand_held_path(1, RATE_HZ)[0]
    turns = [begin @ from_rt(so3_exp(np.array([0, np.radians(i), 0])), np.zeros(3)) for i in range(TURNING)]
    return turns + [turns[-1] @ from_rt(np.eye(3), np.array([0.02 * i, 0, 0])) for i in range(1, MOVING + 1)]


@pytest.fixture(scope="module")
def film() -> list[tuple[np.ndarray, np.ndarray]]:
    """Images and exact depths along the path."""
    renderer = Renderer(furnished_room(0), synthetic_camera(320, 240))
    drawn = [renderer.draw(pose) for pose in path()]
    return [(np.clip(np.round(luma), 0, 255).astype(np.uint8), depth) for luma, depth in drawn]


def play(
    film: list[tuple[np.ndarray, np.ndarray]], config: TrackingConfig
) -> tuple[list[FrameResult], list[int]]:
    """Results of all frames, and which became keyframes; each keyframe's depth comes at once."""
    tracker, results, keyframes = Tracker(config), [], []
    for i, (image, depth) in enumerate(film):
        stamp_ns = round(i * 1e9 / RATE_HZ)
        results.append(tracker.process(i, stamp_ns, image, synthetic_camera(320, 240)))
        keyframe = tracker.maybe_keyframe()
        tracker.map_keyframe()
        if keyframe is not None:
            keyframes.append(i)
            tracker.add_depth(keyframe.id, depth, IDENTITY, 0.1)
    return results, keyframes


def sigma(result: FrameResult) -> tuple[float, float]:
    """The least certain direction of position (m), and of orientation (rad)."""
    values = [np.linalg.eigvalsh(result.covariance[part, part])[-1] for part in (slice(0, 3), slice(3, 6))]
    return float(np.hypot(np.sqrt(values[0]), result.unobserved)), float(np.sqrt(values[1]))


def test_while_it_turns_orientation_goes_out_and_translation_counts_as_unobserved(film):
    results, keyframes = play(film, CONFIG)
    turning, depth = results[1:TURNING], float(np.median(film[0][1]))
    assert all(r.odometry == OK and r.world_from_camera is not None for r in turning)
    true = path()
    for i, result in enumerate(turning, start=1):
        error = inverse(inverse(true[0]) @ true[i]) @ result.world_from_camera
        assert rotation_angle(error[:3, :3]) < np.radians(0.5)
        assert sigma(result)[1] < np.radians(1.0)
        assert sigma(result)[0] > 0.25 * depth
        assert result.parallax_deg == LEAST_PARALLAX_DEG
    # The second keyframe waited while the first view was in sight; then the map went on without parallax.
    assert any(0 < i < TURNING for i in keyframes)
    # The first baseline ends it, for good.
    observed = [sigma(r)[0] < 0.1 for r in results[TURNING:]]
    assert observed[-1]
    assert results[-1].parallax_deg > 1.5, "a baseline of half a metre"
    first = observed.index(True)
    assert all(observed[first:])
    assert first > 0


def test_a_camera_that_moves_at_once_has_its_baseline_with_the_second_keyframe(film):
    results, keyframes = play(film[TURNING:], CONFIG)
    observed = [sigma(r)[0] < 0.1 for r in results]
    assert not any(observed[1 : keyframes[1] + 1])
    assert all(observed[keyframes[1] + 2 :])


def test_without_two_views_the_second_keyframe_waits_for_nothing(film):
    config = replace(CONFIG, keyframe_max_s=0.2)
    waiting, at_once = (play(film[:TURNING], replace(config, two_views=both))[1] for both in (True, False))
    assert len(at_once) > 1
    assert at_once[1] < min(waiting[1:], default=TURNING)


def test_a_quarter_of_the_points_say_from_how_wide_apart_the_map_was_seen():
    rng, table = np.random.default_rng(3), PointTable()
    table.add(400, parallax_deg=rng.uniform(0.0, 9.0, 400))
    rows = rng.permutation(400)[:101]
    least = best_parallax(table, rows, 525.0)
    assert np.count_nonzero(table.parallax_deg[rows] >= least) == 26
    table.parallax_deg[:] = 0.01
    for few in (rows, rows[:1], rows[:0]):
        assert best_parallax(table, few, 525.0) == LEAST_PARALLAX_DEG


@pytest.mark.parametrize(("focal", "times"), [(525.0, 1.0), (262.5, math.sqrt(2.5)), (1e9, math.sqrt(0.5))])
def test_coarser_pixels_need_more_parallax_for_as_good_a_map(focal: float, times: float):
    table, rows = PointTable(), np.arange(10)
    table.add(10, parallax_deg=np.full(10, 3.0))
    assert best_parallax(table, rows, focal) == pytest.approx(3.0 / times)
    table.parallax_deg[:] = 0.51
    assert best_parallax(table, rows, focal) >= LEAST_PARALLAX_DEG, "a network's depth knows no pixels"


def test_what_a_frame_says_of_its_map_goes_with_its_camera(film, monkeypatch):
    coarse = play(film[TURNING:], CONFIG)[0][-1].parallax_deg
    monkeypatch.setattr(baseline, "FITTED_FOCAL_PX", 262.5)  # as this camera's
    assert play(film[TURNING:], CONFIG)[0][-1].parallax_deg == pytest.approx(math.sqrt(2.5) * coarse)


def test_each_part_of_a_map_has_a_baseline_of_its_own():
    baselines = Baselines()
    assert baselines.without(0.7, 0) == 0.7
    assert baselines.without(0.0, 0) == 0.0
    assert baselines.without(0.7, 0) == 0.0, "for good"
    assert baselines.without(0.6, 9) == 0.6
    assert baselines.without(0.0, 9) == baselines.without(0.6, 9) == 0.0


def test_points_of_another_part_that_are_only_tried_give_none():
    """While a new part waits for its depth, the camera is looked for in the rest of the map."""
    run = in_the_dark(30, 0.4)
    room = other_room()
    tracker = run.tracker
    for at, (image, depth, _) in enumerate(room[:30], start=42):
        result = run.feed(0, image, at=at)
        if tracker._waiting is not None:
            home = tracker.world.keyframes[0]
            points = home.points[home.observed()]
            tracker._frames.refresh_local_map(tracker.world, points)
            film = footage()
            view = View(film.camera, tracker._extractor.extract(film.images[0], film.camera))
            tried = tracker._frames.track(tracker.world, view, home.world_from_camera, None, 20)
            assert tried is not None
            assert tried.unobserved == 0.0
        for k, frame in run.keyframes.items():
            if frame == at:
                tracker.add_depth(k, depth, IDENTITY, 0.1)
        if result.world_from_camera is not None:
            break
    assert not result.in_map
    assert result.unobserved > 0.0


def test_of_a_frame_that_matches_nothing_the_doubt_is_a_number():
    assert unobserved_translation(LocalMap(), np.eye(4), np.zeros(0, np.intp)) == UNOBSERVED
