"""The gate as keyframe and depth messages drive it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from prism_edge.config import GateConfig, ScaleConfig
from prism_edge.scale.estimator import ScaleEstimator
from prism_edge.scale.gate_keyframes import KeyframeGate
from tests.scale.scene import CAMERA, SHAPE, depth_of, keyframe_of_wall
from tests.tracking.cloud import pose_at

FITTED = {"dsug_tau": 0.2, "dsug_temperature": 0.05}


def with_thing(depth, left=20, right=60):
    """The same depth with something at half the distance in some columns."""
    values = depth.depth.copy()
    values[:, left:right] *= 0.5
    return replace(depth, depth=values)


def behind_it(keyframe, left=20, right=60):
    """Which keypoints lie in those columns, and which well outside."""
    column = keyframe.pixels[:, 0] / CAMERA.width * SHAPE[1]
    return (column > left + 3) & (column < right - 3), (column < left - 3) | (column > right + 3)


def play(estimator, depths):
    gates = []
    for k, change in enumerate(depths):
        keyframe = keyframe_of_wall(k, 0.4 * k)
        gates.append((keyframe, *estimator.process(keyframe, change(depth_of(keyframe, **FITTED)))))
    return gates


def test_a_thing_that_appears_loses_its_weight_and_the_rest_keeps_theirs():
    *_, (keyframe, scale, gate) = play(ScaleEstimator(ScaleConfig()), [lambda d: d, lambda d: d, with_thing])
    inside, outside = behind_it(keyframe)
    assert gate.uncertainty[inside] == pytest.approx(math.log(2.0), abs=0.05)
    assert np.all(gate.weights[inside] < 0.01)
    assert np.all(gate.weights[outside] > 0.95)
    assert scale.observation == pytest.approx(0.0, abs=0.02)


def test_without_the_gate_the_same_thing_pulls_at_the_scale():
    half = lambda depth: with_thing(depth, 0, 75)  # noqa: E731
    observed = {}
    for ablate in ((), ("dsug",)):
        *_, (_, scale, gate) = play(ScaleEstimator(ScaleConfig(), ablate), [lambda d: d, lambda d: d, half])
        observed[ablate] = abs(scale.observation)
        assert np.all(gate.weights == 1.0) == bool(ablate)
    assert observed["dsug",] > 0.1 > 3 * observed[()]


def test_a_network_without_tau_and_t_leaves_the_gate_open():
    keyframe = keyframe_of_wall(0, 0.0)
    gate = KeyframeGate(GateConfig())
    for _ in range(2):
        assert gate.assess(keyframe, depth_of(keyframe), CAMERA, 0.0) is None
        assert gate.images() is None


@pytest.mark.parametrize(
    "said", [{"tau": 0.0}, {"tau": -0.2}, {"tau": math.nan}, {"temperature": 0.0}, {"temperature": -0.05}]
)
def test_a_tau_or_a_t_that_can_not_be_leaves_the_gate_open(said):
    told = {f"dsug_{name}": value for name, value in said.items()}
    depth = depth_of(keyframe_of_wall(0, 0.0), **(FITTED | told))
    assert KeyframeGate(GateConfig()).parameters(depth) is None


def test_a_view_has_its_depth_in_the_map_s_unit_by_its_own_points_else_by_the_filter():
    for points, units in ((200, 2.5), (5, math.exp(-0.3))):
        gate, keyframe = KeyframeGate(GateConfig()), keyframe_of_wall(0, 0.0, 0.4, points)
        gate.assess(keyframe, depth_of(keyframe, **FITTED), CAMERA, 0.3)
        assert gate._newest is not None
        assert gate._newest[0].units_per_metre == pytest.approx(units, rel=1e-3)


def test_a_keypoint_is_looked_up_where_the_lens_has_put_it():
    """Up to twenty pixels from its ideal place: there the network may have seen another thing."""
    bent = replace(CAMERA, distortion=(-0.2, 0.05, 0.0, 0.0))
    keyframe = keyframe_of_wall(0, 0.0, camera=bent)
    confidence = np.tile(np.linspace(0.1, 0.9, SHAPE[1], dtype=np.float32), (SHAPE[0], 1))
    depth = replace(depth_of(keyframe, camera=bent, **FITTED), confidence=confidence)
    gated = KeyframeGate(GateConfig()).assess(keyframe, depth, bent, 0.0)
    rays = (keyframe.pixels - [bent.cx, bent.cy]) / [bent.fx, bent.fy]
    raw = bent.project(np.column_stack([rays, np.ones(len(rays))]))
    assert np.abs(raw - keyframe.pixels).max() > 20.0
    column = np.rint((raw[:, 0] + 0.5) / CAMERA.width * SHAPE[1] - 0.5).astype(int)
    assert gated.uncertainty == pytest.approx(1.0 - confidence[0, column], abs=1e-5)


def test_the_configurations_tau_and_t_win():
    depth = depth_of(keyframe_of_wall(0, 0.0), **FITTED)
    assert KeyframeGate(GateConfig()).parameters(depth).tau == 0.2
    own = KeyframeGate(GateConfig(tau=0.3, temperature=0.1)).parameters(depth)
    assert (own.tau, own.temperature) == (0.3, 0.1)


def test_the_images_show_u_and_w_of_every_pixel():
    gate = KeyframeGate(GateConfig())
    for k in range(2):
        keyframe = keyframe_of_wall(k, 0.4 * k)
        depth = depth_of(keyframe, **FITTED)
        gate.assess(keyframe, with_thing(depth) if k else depth, CAMERA, 0.0)
    uncertainty, weight = gate.images()
    assert uncertainty.shape == weight.shape == SHAPE
    assert np.median(uncertainty[20:100, 25:55]) == pytest.approx(math.log(2.0), abs=0.05)
    assert np.all(weight[20:100, 25:55] < 0.01)
    assert np.all(weight[20:100, 80:150] > 0.95)


@pytest.mark.parametrize("between", [None, {"valid": False}, "later", "never"])
def test_views_follow_a_correction_also_behind_keyframes_without_depth(between):
    """The correction is said of the keyframe before, which has no view."""
    estimator, moved = ScaleEstimator(ScaleConfig()), pose_at(40.0, 1.0, -2.0, 0.3, 0.5)
    first, blind, last = (keyframe_of_wall(k, 0.4 * k) for k in range(3))
    last = replace(last, world_from_camera=moved, anchor=1, world_from_anchor=moved)
    estimator.process(first, depth_of(first, **FITTED))
    blind = replace(blind, anchor=0)
    if between == "later":  # its depth comes when the correction is known
        estimator.hear(blind)
        estimator.hear(last)
        estimator.process(blind, depth_of(blind, **FITTED))
    elif between == "never":  # nor a word that none will
        estimator.hear(blind)
    else:
        estimator.process(blind, None if between is None else depth_of(blind, **FITTED, **between))
    gate = estimator.process(last, depth_of(last, **FITTED))[1]
    assert np.isfinite(gate.uncertainty).mean() > 0.9
    assert np.nanmax(gate.uncertainty) < 0.02


def test_a_keyframe_that_is_noted_again_lies_where_a_correction_has_put_it_since():
    """Its depth has come late: what the keyframe itself says of its place is out of date by then."""
    gate, moved = KeyframeGate(GateConfig()), pose_at(40.0, 1.0, -2.0, 0.3, 0.5)
    first, second, third = (keyframe_of_wall(k, 0.4 * k, points=1) for k in range(3))
    second = replace(second, world_from_camera=pose_at(0.1), anchor=0)
    third = replace(third, anchor=1, world_from_anchor=moved @ pose_at(0.1))
    for keyframe in (first, second, third):
        gate.note(keyframe)
    assert gate.note(second) == pytest.approx(moved @ pose_at(0.1))
    assert gate.note(first) == pytest.approx(moved)


def test_no_more_poses_are_remembered_than_need_be():
    gate = KeyframeGate(GateConfig())
    for k in range(200):
        gate.note(keyframe_of_wall(k, 0.4 * k, points=1))
    assert len(gate._gate._places) == 64


def test_a_new_map_forgets_the_old_ones_views():
    estimator = ScaleEstimator(ScaleConfig())
    play(estimator, [lambda d: d, lambda d: d])
    keyframe = keyframe_of_wall(9, 4.0, epoch=1)
    _, gate = estimator.process(keyframe, with_thing(depth_of(keyframe, **FITTED)))
    assert np.isnan(gate.uncertainty).all()
    assert np.all(gate.weights == 1.0)


@pytest.mark.parametrize(
    "damage",
    [
        {"depth": np.full(SHAPE, np.nan, np.float32)},
        {"depth": np.zeros((0, 0), np.float32)},
        {"confidence": np.ones((3, 5), np.float32)},
        {"confidence": np.full(SHAPE, np.nan, np.float32)},
        {"image_to_depth": np.full(4, np.nan)},
        {"image_to_depth": np.zeros(4)},
        {"dsug_tau": -1.0},
        {"dsug_temperature": math.inf},
    ],
)
def test_damaged_depth_gives_finite_weights(damage):
    estimator = ScaleEstimator(ScaleConfig())
    for k in range(3):
        keyframe = keyframe_of_wall(k, 0.4 * k)
        depth = replace(depth_of(keyframe, **FITTED), **(damage if k == 1 else {}))
        scale, gate = estimator.process(keyframe, depth)
        assert np.isfinite(gate.weights).all()
        assert ((gate.weights >= 0) & (gate.weights <= 1)).all()
        assert math.isfinite(scale.log_scale)


@pytest.mark.parametrize(
    "placed", [(0.25, 0.0, -0.25, 0.0), (0.0, 0.0, 0.25, 0.0), (0.25, np.nan, 0.25, 0.0)]
)
def test_a_depth_map_that_lies_nowhere_in_the_image_opens_the_gate(placed):
    """Mirrored, shrunk to a line, or at no number: as its place is wrong, so would be every weight."""
    keyframe, gate = keyframe_of_wall(0, 0.0), KeyframeGate(GateConfig())
    depth = depth_of(keyframe, **FITTED)
    assert gate.assess(keyframe, depth, CAMERA, 0.0) is not None
    assert gate.images() is not None
    assert gate.assess(keyframe, replace(depth, image_to_depth=np.array(placed)), CAMERA, 0.0) is None
    assert gate.images() is None, "nor are those of the one before"


def test_samples_weigh_by_the_trust_in_their_points():
    """Points that have only just come are those on something that moves: their map depth is wrong."""
    keyframe = keyframe_of_wall(1, 0.4)
    new = np.arange(200) < 130
    depths = np.where(new, keyframe.depths * np.float32(1.6), keyframe.depths)
    found = {}
    for name, trust in (("alike", np.ones(200)), ("earned", np.where(new, 0.05, 0.9)), ("none", np.zeros(0))):
        told = replace(keyframe, depths=depths, trust=trust.astype(np.float32))
        found[name] = ScaleEstimator(ScaleConfig()).process(told, depth_of(told))[0].observation
    assert abs(found["alike"]) > 0.2
    assert abs(found["earned"]) < 0.06
    assert found["none"] == found["alike"]


@pytest.mark.parametrize("trust", [np.full(200, np.nan), np.zeros(200), np.ones(3), np.full(200, -1.0)])
def test_trust_that_makes_no_sense_is_as_good_as_none(trust):
    keyframe = replace(keyframe_of_wall(1, 0.4), trust=trust.astype(np.float32))
    scale, _ = ScaleEstimator(ScaleConfig()).process(keyframe, depth_of(keyframe))
    assert scale.points == 200
    assert scale.observation == pytest.approx(0.0, abs=1e-3)


def test_the_estimator_s_gate_is_the_configured_one():
    """The network gives no tau and T, the configuration does."""
    uncertainty = {}
    for name, config in (("none", GateConfig()), ("set", GateConfig(tau=0.2, temperature=0.05))):
        estimator = ScaleEstimator(ScaleConfig(), gate=config)
        for k in range(2):
            keyframe = keyframe_of_wall(k, 0.4 * k)
            uncertainty[name] = estimator.process(keyframe, depth_of(keyframe))[1].uncertainty
    assert np.isnan(uncertainty["none"]).all()
    assert np.isfinite(uncertainty["set"]).mean() > 0.9
