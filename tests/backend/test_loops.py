"""Verification of one candidate, on places seen twice and on such that only seem so."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest

from prism_edge.backend import loops
from prism_edge.backend.connectivity import Way
from prism_edge.backend.global_map import GlobalMap, GlobalPoint, no_features
from prism_edge.backend.loops import (
    HELD,
    Found,
    Loop,
    Surroundings,
    _first_pose,
    _likelier,
    _unit_ratio,
    plausible,
    verify,
)
from prism_edge.geometry.poses import inverse, rotation_angle, se3_log
from tests.backend.ring import Ring
from tests.backend.world import Teller, chain
from tests.tracking.cloud import descriptors, pose_at

DRIFT = np.array([0.012, 0.006, -0.012, 0.002, -0.004, 0.002])


def walked(count: int = 42, **options) -> tuple[Ring, GlobalMap]:
    ring, world = Ring(**options), GlobalMap()
    for message in ring.keyframes(count):
        world.absorb(message)
    return ring, world


@pytest.fixture(scope="module")
def drifted() -> tuple[Ring, GlobalMap]:
    return walked(drift=DRIFT, stretch=1.004)


def test_a_return_is_placed_where_the_old_end_has_it(drifted):
    ring, world = drifted
    loop = verify(world, 41, 2, 30)
    assert loop is not None
    there = inverse(world.keyframes[2].world_from_camera) @ loop.world_from_query
    assert np.abs(se3_log(inverse(inverse(ring.true[2]) @ ring.true[41]) @ there)).max() < 0.03
    assert loop.neighbours >= 2
    assert loop.scale == pytest.approx(1.004**-40, abs=0.02)
    right = [ring.point_of[p] for _, p in loop.pairs]
    message_points = world.keyframes[41].observed
    shows = {keypoint: ring.point_of[p] for p, keypoint in message_points.items()}
    assert np.mean([shows[i] == p for (i, _), p in zip(loop.pairs, right, strict=True)]) > 0.98
    assert plausible(world, loop, None)


def test_one_seed_gives_one_answer(drifted):
    _, world = drifted
    a, b = verify(world, 41, 2, 30, seed=3), verify(world, 41, 2, 30, seed=3)
    assert a.world_from_query.tobytes() == b.world_from_query.tobytes()
    assert a.pairs == b.pairs


def test_another_place_is_none(drifted):
    _, world = drifted
    assert verify(world, 41, 20, 30) is None


@pytest.mark.parametrize(("fresh", "closes"), [(10, True), (9, False)])
def test_a_return_to_what_the_query_sees_already_closes_nothing(drifted, fresh, closes):
    """Nothing would be joined, and what is moved by it would be moved anew with each keyframe."""
    _, world = deepcopy(drifted)
    loop = verify(world, 41, 2, 30)
    assert loop is not None
    unknown = [pair for pair in loop.pairs if pair[1] not in world.keyframes[41].observed]
    assert len(unknown) > 30
    for keypoint, point in unknown[fresh:]:
        world.observe(41, point, keypoint)
    assert (verify(world, 41, 2, 30) is not None) == closes


def test_corners_that_look_right_in_wrong_places_are_none():
    """Descriptors as at the place itself, everything else at random."""
    ring = Ring(drift=DRIFT)
    world = GlobalMap()
    messages = ring.keyframes(42)
    rng = np.random.default_rng(5)
    last = messages[41]
    shuffled = rng.uniform((0, 0), (640, 480), last.pixels.shape).astype(np.float32)
    for message in [*messages[:41], replace(last, pixels=shuffled)]:
        world.absorb(message)
    assert verify(world, 41, 1, 30) is None


def test_a_perfect_copy_elsewhere_asks_for_too_much_drift():
    _, world = walked(26, alike=True)
    loop = verify(world, 24, 4, 30)
    assert loop is not None
    assert loop.neighbours >= 2  # nothing in the pictures gives it away
    assert not plausible(world, loop, None)


PERIOD, AGAIN = 0.6, 10_000  # metres; what the points' numbers begin at when they are seen again


def wall_of_windows() -> tuple[GlobalMap, np.ndarray]:
    """Three views of a wall that repeats itself, and a fourth after a way, whose points are new to the map.

    With where the fourth was in truth; the map has it 6 cm aside.
    """
    rng, first, again = np.random.default_rng(3), Teller(), Teller(first=20)
    pattern, looks = rng.uniform((0, -1.5), (PERIOD, 1.5), (40, 2)), descriptors(rng, 40)
    places = [np.pad(pattern, ((0, 0), (0, 1))) + np.array([PERIOD * i, 0.0, 4.0]) for i in range(-8, 8)]
    for teller in (first, again):
        teller.cloud.positions, teller.cloud.descriptors = np.concatenate(places), np.tile(looks, (16, 1))
    world = GlobalMap()
    for x in (-0.2, 0.0, 0.2):
        world.absorb(first.keyframe(pose_at(x)))
    for x in (0.5, 0.1):  # the second is what is looked at, the first one its neighbour
        message = again.keyframe(pose_at(x, 0.02), correction=pose_at(0.06))
        renamed = {"points": message.points + AGAIN, "new_points": message.new_points + AGAIN}
        world.absorb(replace(message, **renamed))
    return world, pose_at(0.1, 0.02)


@pytest.mark.parametrize("sees", [True, False])
def test_who_is_beside_the_query_counts_once_where_it_sees_the_place(sees):
    world, true = wall_of_windows()
    if not sees:
        world.keyframes[20].features = no_features()
    loop = verify(world, 21, 1, 30)
    assert loop is not None
    assert np.linalg.norm((loop.world_from_query - true)[:3, 3]) < 0.01
    assert loop.neighbours == int(sees)


@pytest.mark.parametrize("aside", [PERIOD, -PERIOD, 0.0])
def test_of_places_that_look_alike_it_is_the_one_where_the_map_has_it(monkeypatch, aside):
    world, true = wall_of_windows()
    monkeypatch.setattr(loops, "_first_pose", lambda *_: pose_at(aside) @ true)
    loop = verify(world, 21, 1, 30)
    assert loop is not None
    assert np.linalg.norm((inverse(true) @ loop.world_from_query)[:3, 3]) < 0.01


@pytest.mark.parametrize(("held", "stays"), [(HELD, True), (HELD - 1, False)])
def test_a_view_that_holds_on_to_the_place_is_not_a_step_aside_of_it(held, stays):
    """On stairs three times as much may agree a step on: most of what is seen there is other steps."""
    world, true = wall_of_windows()
    view = world.keyframes[21]
    known = [p for p, _ in sorted(world.keyframes[1].observed.items())][:35]
    for point in known[:held]:
        world.observe(view.id, point, 0)
    own = Found(true, np.arange(35), np.array(known))
    aside = Found(pose_at(PERIOD) @ true, np.arange(100), np.arange(100) + 2 * AGAIN)
    assert _likelier(world, view, aside, own, 30) is (own if stays else aside)


@pytest.mark.parametrize("held", [0, 35])
def test_what_a_view_holds_on_to_where_the_blind_guess_is_too_leaves_that(held):
    world, true = wall_of_windows()
    view = world.keyframes[21]
    known = np.array(sorted(view.observed))[:35]
    own = Found(true, np.arange(35), known if held else known + 2 * AGAIN)
    blind = Found(pose_at(0.01) @ true, np.arange(100), np.arange(100) + 2 * AGAIN)
    assert _likelier(world, view, blind, own, 30) is blind


def test_a_blind_guess_stays_where_the_map_s_own_pose_is_far_off(drifted):
    """Or drift of more than the search's radius could never be taken out."""
    _, world = drifted
    loop = verify(world, 41, 2, 30)
    off = inverse(world.keyframes[41].world_from_camera) @ loop.world_from_query
    assert np.linalg.norm(off[:3, 3]) > 0.1


def test_descriptors_all_equal_make_no_wrong_loop():
    """Corners that can't be told apart leave the geometry, which goes for the right place or none."""
    ring, world = Ring(drift=DRIFT), GlobalMap()
    for message in ring.keyframes(42):
        world.absorb(replace(message, descriptors=np.zeros_like(message.descriptors)))
    assert verify(world, 41, 20, 30) is None
    loop = verify(world, 41, 1, 30)
    if loop is not None:
        there = inverse(world.keyframes[1].world_from_camera) @ loop.world_from_query
        assert np.abs(se3_log(inverse(inverse(ring.true[1]) @ ring.true[41]) @ there)).max() < 0.05


def test_two_keyframes_at_one_pose_are_a_loop_without_a_baseline():
    ring, world = walked(41)
    world.absorb(ring.keyframe(ring.true[1]))
    loop = verify(world, 41, 1, 30)
    assert loop is not None
    assert np.abs(se3_log(inverse(ring.true[1]) @ loop.world_from_query)).max() < 0.02


def test_corners_of_two_exact_views_place_one_by_the_other(monkeypatch):
    """Blindly, by nearly all matched corners, through a camera whose focal lengths differ."""
    teller, world = Teller(), GlobalMap()
    for pose in (pose_at(), pose_at(0.5, 0.5, 0.5, 0.0, 0.0, 1.5)):
        world.absorb(teller.keyframe(pose))
    shared = world.keyframes[0].observed.keys() & world.keyframes[1].observed.keys()
    monkeypatch.setattr(loops, "MIN_PNP", int(0.9 * len(shared)))
    found = _first_pose(world, world.keyframes[1], world.keyframes[0], 0)
    assert found is not None
    off = inverse(teller.poses[1]) @ found
    assert rotation_angle(off[:3, :3]) < np.radians(1.0)
    assert np.linalg.norm(off[:3, 3]) < 0.05


@pytest.mark.parametrize("unit", [0.1, 1.0, 10.0])
def test_how_much_drift_is_believed_does_not_depend_on_the_map_s_unit(unit):
    """0.15 of the way, 3, and 0.3 of the depth, 3: both are lengths."""
    world = chain([pose_at(0.3 * unit * i) for i in range(6)])
    for point in world.points.values():
        point.position[2] *= unit
    for k, keyframe in world.keyframes.items():
        keyframe.travelled = 0.6 * unit * k
    for asked, believed in ((1.3, True), (1.4, False)):
        there = world.keyframes[5].world_from_camera.copy()
        there[1, 3] += asked * unit
        assert plausible(world, Loop(5, 0, there, 1.0, 0.01, 50, 3, []), None) == believed


@pytest.mark.parametrize(
    ("way", "most"), [(0.0, 0.05), (0.2, 0.15), (0.6, 0.35), (0.8, 0.42), (2.0, 0.6)], ids=lambda x: f"{x:g}"
)
def test_a_short_way_has_not_been_for_nothing(way, most):
    """Of stairs one step on: a loop that takes most of it back. ``way`` and ``most`` in median depths."""
    world = chain([pose_at(0.3 * i) for i in range(6)])
    depth = loops.median_depth(world, world.keyframes[5])
    for k, keyframe in world.keyframes.items():
        keyframe.travelled = way * depth * k / 5
    for asked, believed in ((0.97 * most, True), (1.03 * most, False)):
        there = world.keyframes[5].world_from_camera.copy()
        there[1, 3] += asked * depth
        assert plausible(world, Loop(5, 0, there, 1.0, 0.01, 50, 3, []), None) == believed


@pytest.mark.parametrize(("each_deg", "asked_deg"), [(0.0, 10.7), (30.0, 18.2)])
def test_who_has_turned_much_may_have_turned_wrongly(each_deg, asked_deg):
    """10 degrees, half of one a depth, and a twentieth of what the camera turned by to and fro."""
    each = np.radians(each_deg)
    world = chain([pose_at(0.3 * i, 0.0, 0.0, 0.0, each * (i % 2)) for i in range(6)])
    depth = loops.median_depth(world, world.keyframes[5])
    for k, keyframe in world.keyframes.items():
        keyframe.travelled = 0.28 * depth * k
    for asked, believed in ((asked_deg - 0.1, True), (asked_deg + 0.1, False)):
        turn = pose_at(0.0, 0.0, 0.0, 0.0, np.radians(asked))
        there = world.keyframes[5].world_from_camera @ turn
        assert plausible(world, Loop(5, 0, there, 1.0, 0.01, 50, 3, []), None) == believed


def test_the_shorter_way_is_what_counts():
    world = chain([pose_at(0.3 * i) for i in range(6)])
    for k, keyframe in world.keyframes.items():
        keyframe.travelled = 100.0 * k
    there = world.keyframes[5].world_from_camera.copy()
    there[1, 3] += 8.0
    loop = Loop(5, 0, there, 1.0, 0.01, 50, 3, [])
    assert plausible(world, loop, None)
    assert not plausible(world, loop, Way(1.5, 0.0))


def test_points_seen_from_nearer_by_are_looked_for_on_higher_levels():
    teller, world = Teller(noise_px=0.3), GlobalMap()
    for pose in (pose_at(), pose_at(0.05), pose_at(0.0, 0.0, 1.2)):
        world.absorb(teller.keyframe(pose))
    view, surroundings = world.keyframes[2], Surroundings(world, 0, without=2)
    shared = world.keyframes[0].observed.keys() & view.observed.keys()
    risen = [
        p
        for p in shared
        if view.features.octaves[view.observed[p]]
        >= world.keyframes[0].features.octaves[world.keyframes[0].observed[p]] + 2
    ]
    assert len(risen) > 20
    found = surroundings.look(view, teller.poses[2], (7.0,))
    assert found is not None
    assert np.isin(risen, found.points).mean() > 0.8


def test_the_query_s_neighbours_agree_far_from_the_map_s_origin_too():
    """How far off a neighbour is found is a matter of its own camera, not of where the world's zero lies."""
    _, world = walked(drift=DRIFT, stretch=1.004)
    at_home = verify(world, 41, 2, 30)
    world.move(pose_at(3000.0, -2000.0, 100.0, 0.0, 0.7), set(world.keyframes))
    far = verify(world, 41, 2, 30)
    assert at_home is not None
    assert far is not None
    assert far.neighbours == at_home.neighbours >= 2


def test_how_well_the_ratio_of_units_is_known_goes_with_scatter_and_number():
    """A median's standard deviation: of n Gaussians sqrt(pi / 2 n) of theirs."""
    world, rng, count = chain([pose_at()]), np.random.default_rng(4), 200
    for i, error in enumerate(rng.normal(0.0, 0.1, count)):
        world.points[1000 + i] = GlobalPoint(np.array([0.0, 0.0, 2.0 * 3.0 * np.exp(error)]))
    pairs = [(i, 1000 + i) for i in range(count)]
    its = np.array([world.points[p].position for _, p in pairs])
    ratio, sigma = _unit_ratio(world, world.keyframes[0], np.eye(4), pairs, its)
    assert sigma == pytest.approx(0.1 * np.sqrt(np.pi / 2 / count), rel=0.15)
    assert abs(np.log(ratio / 2.0)) < 3.0 * sigma
