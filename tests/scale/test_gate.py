"""The uncertainty gate on walls and things before them, whose depth is known in closed form."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from prism_edge.geometry.cameras import Camera
from prism_edge.geometry.poses import from_rt, so3_exp
from prism_edge.scale.gate import (
    DepthGate,
    DepthView,
    GateParameters,
    combined,
    image_pixels,
    is_open_ended,
    log_discrepancy,
    nearest,
    spatial_uncertainty,
    temporal_uncertainty,
    weigh,
)
from tests.scale.scene import CAMERA, IMAGE_TO_DEPTH, SHAPE

PARAMETERS = GateParameters(alpha=0.5, tau=0.2, temperature=0.05)
NONE = np.zeros((0, 0), np.float32)
BENT = Camera(640, 480, 500.0, 500.0, 319.5, 239.5, distortion=(-0.2, 0.05, 0.0, 0.0))
WALL, THING = 3.0, 1.5  # metres from the world's origin along z


def looking(x: float, y: float = 0.0, z: float = 0.0, pan: float = 0.0) -> np.ndarray:
    return from_rt(so3_exp(np.array([0.0, pan, 0.0])), np.array([x, y, z]))


def view_of(
    pose: np.ndarray,
    thing: tuple[float, float] | None = None,
    number: int = 0,
    camera: Camera = CAMERA,
    factor: float = 1.0,
    units_per_metre: float = 1.0,
    confidence: np.ndarray = NONE,
) -> DepthView:
    """Depth of a wall at z = 3 with, at z = 1.5, a thing that spans ``thing`` = (from, to) in world x."""
    probe = DepthView(number, pose, camera, np.zeros(SHAPE), IMAGE_TO_DEPTH, NONE, 1.0)
    rays = camera.normalise(image_pixels(probe))
    directions = np.column_stack([rays, np.ones(len(rays))]) @ pose[:3, :3].T
    depth = (WALL - pose[2, 3]) / directions[:, 2]
    if thing is not None:
        nearer = (THING - pose[2, 3]) / directions[:, 2]
        x = pose[0, 3] + nearer * directions[:, 0]
        depth = np.where((x >= thing[0]) & (x <= thing[1]), nearer, depth)
    depth = (factor * depth).reshape(SHAPE).astype(np.float32)
    placed = pose.copy()
    placed[:3, 3] *= units_per_metre
    return DepthView(number, placed, camera, depth, IMAGE_TO_DEPTH, confidence, units_per_metre / factor)


def seen_at(camera: Camera, pose: np.ndarray, points: np.ndarray) -> np.ndarray:
    return camera.project((points - pose[:3, 3]) @ pose[:3, :3])


def wall_pixels(view: DepthView, count: int = 300) -> np.ndarray:
    """Raw pixels well inside the image."""
    rng = np.random.default_rng(0)
    return rng.uniform((80, 60), (560, 420), (count, 2))


@pytest.mark.parametrize("camera", [CAMERA, BENT])
@pytest.mark.parametrize("units_per_metre", [1.0, 0.4])
def test_what_stands_still_has_no_uncertainty_however_the_camera_moves(camera, units_per_metre):
    before = view_of(looking(0.0), camera=camera, units_per_metre=units_per_metre)
    now = view_of(looking(0.25, 0.1, 0.3, 0.1), camera=camera, units_per_metre=units_per_metre)
    found = temporal_uncertainty(now, [before], wall_pixels(now), 0.2)
    assert np.isfinite(found).mean() > 0.8
    assert np.nanmax(found) < 0.01
    assert np.all(weigh(found, PARAMETERS)[np.isfinite(found)] > 0.97)


def test_what_lies_far_beside_an_earlier_view_is_unknown_where_the_lens_folds_it_back_into_the_image():
    folding = Camera(640, 480, 500.0, 500.0, 319.5, 239.5, distortion=(-0.15, 0.0, 0.0, 0.0))
    before, now = (view_of(looking(0.0, pan=pan), camera=folding) for pan in (-0.35, 0.65))
    found = temporal_uncertainty(now, [before], image_pixels(now), 0.2)
    common = np.isfinite(found).reshape(SHAPE)
    assert 0.1 < common.mean() < 0.4
    assert not common[:, SHAPE[1] // 2 :].any()  # more than 57 degrees off the earlier axis
    assert np.nanmax(found) < 0.01


def test_without_the_poses_the_same_would_look_like_motion():
    """The compensation is what the test above rests on."""
    before, now = view_of(looking(0.0)), view_of(looking(0.0, 0.0, 0.0, 0.35))
    lying = DepthView(1, before.world_from_camera, CAMERA, now.depth, IMAGE_TO_DEPTH, NONE, 1.0)
    assert np.nanquantile(temporal_uncertainty(lying, [before], wall_pixels(now), 0.2), 0.9) > 0.05


def test_what_moved_in_is_uncertain_by_the_log_of_how_much_nearer_it_is():
    before, now = view_of(looking(0.0)), view_of(looking(0.1), thing=(-0.2, 0.2))
    on_it = np.array([[x, y, THING] for x in (-0.12, 0.0, 0.12) for y in (-0.2, 0.0, 0.2)])
    found = temporal_uncertainty(now, [before], seen_at(CAMERA, now.world_from_camera, on_it), 0.2)
    assert found == pytest.approx(np.log(WALL / THING), abs=0.02)
    assert np.all(weigh(found, PARAMETERS) < 1e-3)


def test_what_something_hid_before_is_not_known():
    """The thing has gone: the wall that it hid is no newcomer, and nothing is held against it."""
    before, now = view_of(looking(0.0), thing=(-0.2, 0.2)), view_of(looking(0.0))
    behind = np.array([[x, 0.1, WALL] for x in (-0.2, 0.0, 0.2)])
    found = temporal_uncertainty(now, [before], seen_at(CAMERA, now.world_from_camera, behind), 0.2)
    assert np.isnan(found).all()
    assert np.all(weigh(found, PARAMETERS) == 1.0)


@pytest.mark.parametrize("factor", [0.6, 1.5])
def test_a_networks_wavering_scale_is_no_motion(factor):
    """The pair's median ratio goes first; the map's own ``units_per_metre`` would hide that, so it is 1."""
    before, now = view_of(looking(0.0)), view_of(looking(0.0, 0.1), factor=factor)
    now = DepthView(1, now.world_from_camera, CAMERA, now.depth, IMAGE_TO_DEPTH, NONE, 1.0)
    assert np.nanmax(np.abs(log_discrepancy(now, before, wall_pixels(now)))) < 0.02


def test_a_raw_pixel_lies_where_image_to_depth_says_and_back():
    """Of an image whose sides were cut off: the two axes have scales and beginnings of their own."""
    image_to_depth, shape = np.array([0.25, -20.0, 0.5, 12.0]), (30, 40)
    raw = np.array([[80.0, -24.0], [160.0, 20.0], [239.0, 35.0], [0.0, 0.0]])
    row, column, inside = nearest(shape, image_to_depth, raw)
    assert inside.tolist() == [True, True, False, False]
    assert (column[:2].tolist(), row[:2].tolist()) == ([0, 20], [0, 22])
    view = DepthView(0, np.eye(4), CAMERA, np.ones(shape), image_to_depth, NONE, 1.0)
    pixels = image_pixels(view)
    np.testing.assert_allclose(pixels[[0, 1, 40]], [[80.0, -24.0], [84.0, -24.0], [80.0, -22.0]])
    row, column, inside = nearest(shape, image_to_depth, pixels)
    assert inside.all()
    np.testing.assert_array_equal(row * 40 + column, np.arange(30 * 40))


def test_what_has_come_across_a_third_of_the_image_is_no_change_of_scale():
    """The pair's median is over all of the image, whatever band of it that is."""
    before, now = view_of(looking(0.0)), view_of(looking(0.0))
    row, column = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]]
    for nearer in (np.abs(row - column) < 20, row < 40, column > 107):
        depth = np.where(nearer, 0.5, 1.0) * now.depth
        closer = DepthView(1, now.world_from_camera, CAMERA, depth, IMAGE_TO_DEPTH, NONE, 1.0)
        found = log_discrepancy(closer, before, image_pixels(closer)).reshape(SHAPE)
        assert np.median(found[nearer]) == pytest.approx(np.log(2.0), abs=0.01)
        assert np.median(found[~nearer]) == pytest.approx(0.0, abs=0.01)


@pytest.mark.parametrize("aside", [-1, 1])
def test_an_edge_that_is_a_pixel_off_is_no_discrepancy(aside):
    """Poses, and where a network draws an edge, are no better than that."""
    before = view_of(looking(0.0), thing=(-0.2, 0.2))

    def drawn_aside(pixels: int) -> np.ndarray:
        depth = np.roll(before.depth, pixels, axis=1)
        now = DepthView(1, before.world_from_camera, CAMERA, depth, IMAGE_TO_DEPTH, NONE, 1.0)
        return np.abs(log_discrepancy(now, before, image_pixels(now)))

    assert np.nanmax(drawn_aside(aside)) < 0.01
    assert np.nanmax(drawn_aside(2 * aside)) == pytest.approx(np.log(WALL / THING), abs=0.01)


@pytest.mark.parametrize(("columns", "says"), [(1, False), (2, True)])
def test_two_views_that_share_less_than_forty_probes_say_nothing_of_each_other(columns, says):
    """24 to a column: their median would be that of whatever a corner of the image shows."""
    shared_px = columns * CAMERA.width / 24
    before = view_of(looking(0.0))
    now = view_of(looking((CAMERA.width - shared_px) * WALL / CAMERA.fx))
    found = log_discrepancy(now, before, image_pixels(now))
    assert np.isfinite(found).any() == says


@pytest.mark.parametrize(("above", "open_ended"), [(4, False), (6, True)])
def test_probabilities_some_of_which_were_upsampled_beyond_one_are_none_without_end(above, open_ended):
    assert is_open_ended(np.array([1.01] * above + [0.5] * (10 - above))) == open_ended


def test_several_views_are_averaged_over_those_that_say_something():
    now = view_of(looking(0.0), thing=(-0.2, 0.2))
    hid, through = view_of(looking(0.0), thing=(-0.2, 0.2)), view_of(looking(0.05))
    pixel = seen_at(CAMERA, now.world_from_camera, np.array([[0.0, 0.0, THING]]))
    half = 0.5 * np.log(WALL / THING)
    assert temporal_uncertainty(now, [hid, through], pixel, 0.2) == pytest.approx(half, abs=0.02)
    wall = seen_at(CAMERA, now.world_from_camera, np.array([[0.6, 0.0, WALL]]))
    partly = view_of(looking(0.0), thing=(0.15, 0.6))
    assert temporal_uncertainty(now, [through, partly], wall, 0.2) == pytest.approx(0.0, abs=0.02)
    assert np.isnan(temporal_uncertainty(now, [partly], wall, 0.2)).all()


def test_views_with_too_little_in_common_say_nothing():
    now, elsewhere = view_of(looking(0.0)), view_of(looking(0.0, pan=2.5))
    assert np.isnan(temporal_uncertainty(now, [elsewhere], wall_pixels(now), 0.2)).all()


@pytest.mark.parametrize("value", [0.0, np.nan, np.inf, -1.0])
def test_depth_that_is_none_says_nothing(value):
    now, before = view_of(looking(0.0)), view_of(looking(0.1))
    bad = DepthView(1, now.world_from_camera, CAMERA, np.full(SHAPE, value), IMAGE_TO_DEPTH, NONE, 1.0)
    for pair in ((bad, before), (now, bad)):
        assert np.isnan(temporal_uncertainty(pair[0], [pair[1]], wall_pixels(now), 0.2)).all()


@settings(max_examples=60, deadline=None)
@given(st.floats(0, 3), st.floats(0.01, 1.0), st.floats(0.005, 0.5))
def test_the_weight_is_the_papers_sigmoid(u, tau, temperature):
    weight = float(weigh(np.array([u]), GateParameters(0.5, tau, temperature))[0])
    assert 0.0 <= weight <= 1.0
    exponent = (u - tau) / temperature
    if abs(exponent) < 30:
        assert weight == pytest.approx(1.0 / (1.0 + np.exp(exponent)), rel=1e-9)


def test_confidence_is_turned_round_and_never_invented():
    open_ended = spatial_uncertainty(np.array([[1.0, 4.0, 20.0, np.nan, 0.0]]))
    np.testing.assert_allclose(open_ended, [[1.0, 0.25, 0.05, np.nan, np.nan]])
    np.testing.assert_allclose(spatial_uncertainty(np.array([0.2, 0.9])), [0.8, 0.1])
    assert np.isnan(spatial_uncertainty(np.zeros(3))).all()


def test_a_probability_of_zero_is_no_trust_and_one_that_overshoots_turns_nothing_round():
    probability = np.full((6, 8), 0.9, np.float32)
    probability[:, :3] = 0.0
    probability[0, 0], probability[0, 7] = -0.02, 1.09  # as cubic upsampling makes them
    u = spatial_uncertainty(probability)
    np.testing.assert_allclose(u[:, :3], 1.0)
    np.testing.assert_allclose(u[1:, 3:], 0.1, atol=1e-6)
    assert u[0, 7] == 0.0


def test_an_open_ended_confidence_is_known_by_its_values_also_where_hardly_any_is_above_one():
    unsure = np.ones((6, 8))
    unsure[0, 0] = 1.5
    np.testing.assert_allclose(spatial_uncertainty(unsure)[1:], 1.0)
    wide = np.linspace(0.2, 8.0, 20)  # goes below 1, as a softplus does
    np.testing.assert_allclose(spatial_uncertainty(wide), 1.0 / np.maximum(wide, 1.0))


def test_u_is_the_mix_and_of_one_that_is_missing_the_other():
    spatial, temporal = np.array([0.4, np.nan, 0.4, np.nan]), np.array([0.1, 0.1, np.nan, np.nan])
    np.testing.assert_allclose(combined(spatial, temporal, 0.25), [0.175, 0.1, 0.4, np.nan])


def test_the_gate_mixes_confidence_in_at_the_pixel():
    gate = DepthGate(2)
    gate.remember(view_of(looking(0.0)))
    confidence = np.full(SHAPE, 20.0)
    confidence[:, : SHAPE[1] // 2] = 1.25  # the left half is a blur
    now = view_of(looking(0.1), confidence=confidence)
    gated = gate.assess(now, np.array([[100.0, 200.0], [500.0, 200.0]]), PARAMETERS)
    np.testing.assert_allclose(gated.uncertainty, [0.4, 0.025], atol=0.01)
    assert gated.weights[0] < 0.03 < 0.9 < gated.weights[1]


def test_where_confidence_is_unknown_only_motion_is_held_against_a_pixel():
    gate = DepthGate(2)
    gate.remember(view_of(looking(0.0)))
    confidence = np.full(SHAPE, 0.95)
    confidence[:, : SHAPE[1] // 2] = np.nan
    now = view_of(looking(0.1), confidence=confidence)
    gated = gate.assess(now, np.array([[100.0, 200.0], [500.0, 200.0]]), PARAMETERS)
    np.testing.assert_allclose(gated.uncertainty, [0.0, 0.025], atol=0.01)


def test_the_first_view_without_confidence_weighs_fully():
    gated = DepthGate(3).assess(view_of(looking(0.0)), np.array([[100.0, 200.0]]), PARAMETERS)
    assert np.isnan(gated.uncertainty).all()
    assert gated.weights.tolist() == [1.0]


def test_a_correction_of_the_map_takes_all_views_along():
    gate, moved = DepthGate(3), looking(4.0, 1.0, -2.0, 1.0)
    for number, x in enumerate((0.0, 0.1)):
        gate.remember(view_of(looking(x), number=number))
    now = view_of(looking(0.2), number=2)
    corrected = DepthView(2, moved @ now.world_from_camera, CAMERA, now.depth, IMAGE_TO_DEPTH, NONE, 1.0)
    stale = gate.copy().assess(corrected, wall_pixels(now), PARAMETERS).uncertainty
    gate.rebase(1, moved @ looking(0.1))
    fresh = gate.assess(corrected, wall_pixels(now), PARAMETERS).uncertainty
    assert not np.any(stale < 0.01)
    assert np.nanmax(fresh) < 0.01


def test_a_view_that_is_unknown_moves_nothing():
    gate = DepthGate(1)
    gate.remember(view_of(looking(0.0), number=7))
    gate.rebase(3, looking(5.0))
    found = gate.assess(view_of(looking(0.1)), wall_pixels(view_of(looking(0.1))), PARAMETERS).uncertainty
    assert np.nanmax(found) < 0.01
