"""A weak frame beside the newest keyframe: put right where it is wrong, left alone where it is not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from prism_edge.geometry.poses import inverse, rotation_angle, se3_exp, transform
from prism_edge.tracking.features import Features, OrbExtractor
from prism_edge.tracking.frame_tracking import TrackedFrame
from prism_edge.tracking.local_map import NO_POINT
from prism_edge.tracking.matching import match_corners
from prism_edge.tracking.motion import Prediction
from prism_edge.tracking.second_look import MIN_POINTS, WEAK_MATCHES, look_again, two_views
from tests.tracking.film_run import BLACK, CONFIG, Run
from tests.tracking.footage import footage

AWAY = 12  # frames after the newest keyframe


@pytest.fixture(scope="module")
def run() -> Run:
    run = Run()
    run.play(range(40))
    assert run.tracker.parts.size(run.tracker.world) > 1
    return run


def weak_frame(run: Run, error: np.ndarray, matched: int = 30) -> TrackedFrame:
    """A later frame as tracking leaves it that lost its way: ``error`` off, on a few points."""
    film = footage()
    index = run.tracker.world.newest().index + AWAY
    features = OrbExtractor(CONFIG).extract(film.images[index], film.camera)
    points = np.full(len(features), NO_POINT, np.int64)
    pose = film.poses[index] @ se3_exp(error)
    return TrackedFrame(film.camera, features, pose, points, np.eye(6), matched)


def look(run: Run, frame: TrackedFrame) -> TrackedFrame:
    world, parts = run.tracker.world, run.tracker.parts
    frames = run.tracker._frames
    return look_again(world, parts, frames, frame, parts.newest(world), seed=0)


def off(run: Run, frame: TrackedFrame) -> tuple[float, float]:
    """Error of a frame's motion since the newest keyframe: rad, and of its way over the true one."""
    film, newest = footage(), run.tracker.world.newest()
    true = inverse(film.poses[newest.index]) @ film.poses[newest.index + AWAY]
    found = inverse(newest.world_from_camera) @ frame.world_from_camera
    way = float(np.linalg.norm(found[:3, 3] - true[:3, 3]) / np.linalg.norm(true[:3, 3]))
    return rotation_angle(found[:3, :3].T @ true[:3, :3]), way


TURN_FOR_A_WAY = np.array([-0.12, 0.0, 0.0, 0.0, np.radians(4.0), 0.0])


def test_what_looks_alike_puts_a_wrong_motion_right(run):
    wrong = weak_frame(run, TURN_FOR_A_WAY)
    assert off(run, wrong)[0] > np.radians(3.5)
    found = look(run, wrong)
    angle, way = off(run, found)
    assert angle < np.radians(0.3)
    assert way < 0.15
    world, newest = run.tracker.world, run.tracker.world.newest()
    seen = np.flatnonzero(found.points != NO_POINT)
    assert found.matched == len(seen) > 30
    assert np.isin(found.points[seen], newest.points).all()
    positions = world.points.position[world.points.rows(found.points[seen])]
    pixels = footage().camera.project(transform(inverse(found.world_from_camera), positions))
    assert np.median(np.linalg.norm(pixels - found.features.pixels[seen], axis=1)) < 3.0, "the points it saw"


def test_what_looks_alike_and_is_elsewhere_is_no_point_of_the_frame(run):
    wrong, rng = weak_frame(run, TURN_FOR_A_WAY), np.random.default_rng(2)
    moved = rng.permutation(len(wrong.features))[: len(wrong.features) // 10]
    pixels = wrong.features.pixels.copy()
    pixels[moved] += 30.0 * rng.choice([-1.0, 1.0], (len(moved), 2))
    width, height = footage().camera.width, footage().camera.height
    octaves, words = wrong.features.octaves, wrong.features.descriptors
    found = look(run, replace(wrong, features=Features.build(pixels, octaves, words, width, height)))
    assert found.matched > 100
    assert (found.points[moved] != NO_POINT).mean() < 0.05


def spread(frame: TrackedFrame) -> np.ndarray:
    """Standard deviations along the frame's axes, map units, and about them, rad."""
    return np.sqrt(np.diag(frame.covariance))


def test_its_uncertainty_is_that_of_the_points_it_keeps(run):
    """Not of the motion that they contradict, however sure that seemed."""
    sure, unsure = (weak_frame(run, TURN_FOR_A_WAY) for _ in range(2))
    sure.covariance, unsure.covariance = 1e-12 * np.eye(6), 1e6 * np.eye(6)
    found = look(run, sure)
    assert np.array_equal(found.covariance, look(run, unsure).covariance)
    assert 1e-3 < spread(found)[:3].max() < 0.3
    assert 1e-4 < spread(found)[3:].max() < 0.1
    assert np.array_equal(found.covariance, found.covariance.T)


def test_and_where_no_two_views_had_parallax_its_place_rests_on_the_network_s_depth(run):
    world = run.tracker.world
    parallax = world.points.parallax_deg.copy()
    firm = look(run, weak_frame(run, TURN_FOR_A_WAY))
    world.points.parallax_deg[:] = 0.0
    loose = look(run, weak_frame(run, TURN_FOR_A_WAY))
    world.points.parallax_deg[:] = parallax
    assert np.array_equal(loose.world_from_camera, firm.world_from_camera)
    assert loose.unobserved > 0.7 > spread(firm)[:3].max()
    assert firm.unobserved == 0.0
    assert np.allclose(loose.covariance, firm.covariance)


def test_the_motions_that_looks_find_are_good_for_going_on():
    """Of maps of several lengths: one alone is luck."""
    errors = []
    for frames in range(8, 40, 4):
        run = Run()
        run.play(range(frames))
        errors.append(off(run, look(run, weak_frame(run, TURN_FOR_A_WAY))))
    angle, way = np.median(errors, axis=0)
    assert angle < np.radians(0.5)
    assert way < 0.15


@pytest.mark.parametrize(("metres", "degrees", "is_moved"), [(0.02, 1.0, False), (0.2, 6.0, True)])
def test_a_camera_is_not_taken_where_it_can_not_have_gone(
    run: Run, metres: float, degrees: float, is_moved: bool
) -> None:
    """The looks' place is 12 cm and 4 degrees from where the frame was expected, and found."""
    wrong = weak_frame(run, TURN_FOR_A_WAY)
    sigmas = np.repeat((metres, np.radians(degrees)), 3)
    expected = Prediction(wrong.world_from_camera, np.diag(sigmas**-2.0))
    expecting = replace(wrong, expected=expected)
    looked = look(run, expecting)
    assert (looked is not expecting) == is_moved
    assert (looked.expected is expected) != is_moved, "what looks have placed rests on them alone"


def test_a_motion_that_agrees_is_left_as_it_is(run):
    right = weak_frame(run, np.zeros(6))
    assert look(run, right) is right


def test_a_frame_that_matches_much_is_not_looked_at_again(run):
    strong = weak_frame(run, TURN_FOR_A_WAY, matched=WEAK_MATCHES)
    assert look(run, strong) is strong


def test_where_looks_find_no_more_than_tracking_did_tracking_is_believed(run):
    wrong = weak_frame(run, TURN_FOR_A_WAY, matched=WEAK_MATCHES - 1)
    sparse = OrbExtractor(replace(CONFIG, features=100, max_features=100))
    features = sparse.extract(footage().images[run.tracker.world.newest().index + AWAY], footage().camera)
    wrong = replace(wrong, features=features, points=wrong.points[: len(features)])
    assert look(run, wrong) is wrong


def test_nothing_to_see_changes_nothing(run):
    wrong = weak_frame(run, TURN_FOR_A_WAY)
    features = OrbExtractor(CONFIG).extract(BLACK, footage().camera)
    dark = replace(wrong, features=features, points=np.zeros(0, np.int64))
    assert look(run, dark) is dark


def test_a_map_of_one_keyframe_is_not_judged_here():
    run = Run()
    run.play(range(3))
    assert run.tracker.parts.size(run.tracker.world) == 1
    wrong = weak_frame(run, TURN_FOR_A_WAY)
    assert look(run, wrong) is wrong


def test_points_that_have_stood_their_time_are_believed_whatever_looks_alike(run):
    """Else the camera would go along with an object that has more corners than what is behind it."""
    wrong, world = weak_frame(run, TURN_FOR_A_WAY), run.tracker.world
    old = world.points.ids[world.points.alive][:8]
    born = world.points.born_ns[world.points.rows(old)].copy()
    wrong.points[:8] = old
    world.points.born_ns[world.points.rows(old)] = world.newest().stamp_ns - 2_000_000_000
    assert look(run, wrong) is wrong
    wrong.points[5:8] = NO_POINT
    assert look(run, wrong) is not wrong, "five don't place a camera"
    world.points.born_ns[world.points.rows(old)] = born


def test_a_point_that_came_to_lie_behind_the_keyframe_says_nothing_of_how_far_it_is(run):
    """A correction may put it there; the way's length is the other points'."""
    world, newest, wrong = run.tracker.world, run.tracker.world.newest(), weak_frame(run, TURN_FOR_A_WAY)
    before, now = match_corners(newest.features, wrong.features)
    views, ids = two_views(world, newest, wrong, before, now, 0, MIN_POINTS)
    behind = world.points.rows(ids[ids != NO_POINT][:1])
    place = world.points.position[behind].copy()
    world.points.position[behind] = newest.world_from_camera[:3, 3] - newest.world_from_camera[:3, 2]
    again, _ = two_views(world, newest, wrong, before, now, 0, MIN_POINTS)
    world.points.position[behind] = place
    assert again.first_from_second == pytest.approx(views.first_from_second, abs=0.02)
    assert again.depth_spread == pytest.approx(views.depth_spread, abs=0.05)
