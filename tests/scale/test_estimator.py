from dataclasses import replace

import numpy as np
import pytest

from prism_edge.config import ScaleConfig
from prism_edge.geometry.cameras import Camera
from prism_edge.scale.estimator import ScaleEstimator
from prism_edge.scale.steady import SteadyScale
from tests.scale.scene import depth_of, keyframe_of_wall

CONFIG = ScaleConfig(hold_sigmas=0.0)  # publishes the estimate itself; holding is test_steady.py's


def play(estimator, count, metres_per_unit=1.0, factor=1.0, start=0, epoch=0, bias=0.1, waver=0.0):
    """Keyframes start.. of an epoch; its first knows only seeded points. Images ``waver`` in turns."""
    results = []
    for k in range(start, start + count):
        parallax = 0.0 if k == start else 3.0
        keyframe = keyframe_of_wall(k, k * 0.4, metres_per_unit, parallax_deg=parallax, epoch=epoch)
        depth = replace(depth_of(keyframe, factor * np.exp(waver * np.sin(0.3 * k))), bias_sigma=bias)
        results.append(estimator.process(keyframe, depth)[0])
    return results


def test_the_first_depth_fixes_the_unit_and_says_how_little_that_means():
    first = play(ScaleEstimator(CONFIG), 1)[0]
    assert first.log_scale == 0.0
    assert first.points == 0
    assert np.isnan(first.observation)
    assert not first.accepted
    assert first.filter_sigma == pytest.approx(np.hypot(0.15, 0.25 / np.sqrt(15)))
    assert first.sigma == pytest.approx(np.hypot(first.filter_sigma, 0.1))


def test_later_keyframes_pull_the_estimate_to_what_the_network_says():
    results = play(ScaleEstimator(CONFIG), 60, metres_per_unit=1.1)
    assert results[-1].log_scale == pytest.approx(np.log(1.1), abs=0.03)
    assert results[-1].observation == pytest.approx(np.log(1.1), abs=1e-3)
    assert results[-1].accepted
    assert results[-1].points == 200
    sigmas = [r.filter_sigma for r in results]
    assert np.all(np.diff(sigmas) < 1e-3)
    assert sigmas[-1] < sigmas[0] / 2
    assert results[-1].sigma > 0.1


def test_a_new_epoch_has_a_new_unit():
    estimator = ScaleEstimator(CONFIG)
    play(estimator, 30, metres_per_unit=1.2)
    again = play(estimator, 20, start=30, epoch=1)
    assert again[0].log_scale == 0.0
    assert again[0].filter_sigma == play(ScaleEstimator(CONFIG), 1)[0].filter_sigma
    assert again[0].epoch == 1
    assert abs(again[-1].log_scale) < 1e-3


def test_a_map_that_was_triangulated_has_a_unit_before_the_first_depth():
    """As for a scale process that was started again: twelve points can't say which."""
    estimator = ScaleEstimator(CONFIG)
    few = keyframe_of_wall(0, 0.0, 1.5, points=12)
    said = estimator.process(few, depth_of(few))[0]
    assert not estimator.metric
    assert said.sigma >= CONFIG.initial_sigma
    many = keyframe_of_wall(1, 0.4, 1.5)
    assert 0.7 * np.log(1.5) < estimator.process(many, depth_of(many))[0].log_scale < np.log(1.5)
    assert estimator.metric


def test_a_stored_map_is_gone_on_with_in_its_own_unit():
    estimator = ScaleEstimator(CONFIG)
    play(estimator, 3)
    estimator.take_over(1000, np.log(1.2), 0.02, bias_sigma=0.1)
    later = keyframe_of_wall(50, 20.0, 1.2, epoch=1000)
    first = estimator.process(later, None)[0]
    assert first.log_scale == pytest.approx(np.log(1.2))
    assert first.map_log_scale == pytest.approx(np.log(1.2))
    assert first.filter_sigma == pytest.approx(0.02, abs=0.005)
    assert first.sigma == pytest.approx(np.hypot(first.filter_sigma, 0.1), rel=1e-3)
    results = play(estimator, 10, metres_per_unit=1.2, start=51, epoch=1000)
    assert all(abs(r.log_scale - np.log(1.2)) < 0.03 for r in results)
    assert estimator.process(keyframe_of_wall(9, 3.0, epoch=0), None) is None  # of the map before


def test_a_sensor_s_own_word_counts_as_much_where_a_map_is_gone_on_with():
    """A filter that begins with a map has seen no more of its source of depth than one that begins."""
    said = {}
    for known in (False, True):
        estimator = ScaleEstimator(CONFIG)
        if known:
            estimator.take_over(0, 0.0, 0.01, bias_sigma=0.01, network="wall")
        for k in range(6):
            keyframe = keyframe_of_wall(k, 0.4 * k)
            depth = replace(depth_of(keyframe), frame_sigma=0.02, bias_sigma=0.01)
            said[known], _ = estimator.process(keyframe, depth)
            if k == 0 and known:
                assert said[known].filter_sigma == pytest.approx(0.01, rel=0.15)
        assert estimator._filter._config.frame_sigma == 0.02
        assert said[known].accepted
    wild = keyframe_of_wall(6, 2.4)
    answer, _ = estimator.process(wild, replace(depth_of(wild, 1.3), frame_sigma=0.02, bias_sigma=0.01))
    assert not answer.accepted, "no sensor errs by 30 %"
    assert 0.005 < said[True].filter_sigma < said[False].filter_sigma


def test_what_was_known_stays_as_well_known_whatever_the_network_spreads():
    for bias in (0.02, 0.05, 0.1, 0.3):
        estimator = ScaleEstimator(CONFIG)
        estimator.take_over(0, np.log(1.2), 0.02, bias_sigma=bias, network="wall")
        keyframe = keyframe_of_wall(0, 0.0)
        blind = replace(depth_of(keyframe), bias_sigma=bias, valid=False)
        for _ in range(2):
            assert estimator.process(keyframe, blind)[0].filter_sigma == pytest.approx(0.02)
        spread = estimator._filter._spread.sigma
        assert spread == pytest.approx(0.15 * bias / 0.1)
        seen = estimator.process(keyframe, replace(blind, valid=True))[0]
        assert seen.accepted
        expected = 0.02 * spread / np.hypot(0.02, spread)  # as Kalman's gain has it for such a spread
        assert seen.filter_sigma == pytest.approx(expected, rel=0.1)


@pytest.mark.parametrize(
    ("network", "own", "bias_sigma"),
    [
        ("wall", "wall", 0.0),
        ("", "wall", 0.0),
        ("another", "wall", np.hypot(0.05, 0.1)),
        ("wall", "wall@0123456789ab", 0.0),  # as a map of an earlier build names it
        ("wall@ba9876543210", "wall@0123456789ab", np.hypot(0.05, 0.1)),
    ],
)
def test_another_network_s_word_for_a_map_s_unit_is_kept_but_doubted(network, own, bias_sigma):
    estimator = ScaleEstimator(ScaleConfig())
    estimator.take_over(0, np.log(1.2), 0.02, bias_sigma=0.05, network=network)
    first = keyframe_of_wall(0, 0.0)
    said = estimator.process(first, replace(depth_of(first), valid=False, model=own))[0]
    assert said.log_scale == pytest.approx(np.log(1.2))
    assert said.network == own
    again = estimator.process(first, replace(depth_of(first), valid=False, model=own))[0]
    for scale in (said, again):  # once
        assert estimator._filter.sigma == pytest.approx(np.hypot(0.02, bias_sigma))
        assert scale.filter_sigma == pytest.approx(estimator._filter.learned_sigma)


def test_a_keyframe_of_an_epoch_that_is_over_gets_no_answer():
    estimator = ScaleEstimator(CONFIG)
    play(estimator, 3, epoch=2)
    late = keyframe_of_wall(9, 3.0, epoch=1)
    assert estimator.process(late, depth_of(late)) is None


def test_an_estimator_started_amid_a_map_takes_that_maps_unit():
    estimator = ScaleEstimator(CONFIG)
    keyframe = keyframe_of_wall(100, 40.0, metres_per_unit=1.25)
    scale, _ = estimator.process(keyframe, depth_of(keyframe))
    assert scale.accepted
    prior, seen = CONFIG.initial_sigma**2, CONFIG.frame_sigma**2
    assert scale.log_scale == pytest.approx(np.log(1.25) * prior / (prior + seen), rel=0.1)


def test_every_keypoint_has_weight_one():
    keyframe = keyframe_of_wall(4, 0.0, points=33)
    _, gate = ScaleEstimator(CONFIG).process(keyframe, depth_of(keyframe))
    assert (gate.keyframe, gate.epoch) == (4, 0)
    assert gate.weights.dtype == np.float32
    np.testing.assert_array_equal(gate.weights, np.ones(33))


@pytest.mark.parametrize("ablate", [("kalman",), ("wls",), ("kalman", "wls"), ("depth_factor",)])
def test_ablated_it_still_finds_a_clean_scale(ablate):
    results = play(ScaleEstimator(CONFIG, ablate), 40, metres_per_unit=0.9)
    assert results[-1].log_scale == pytest.approx(np.log(0.9), abs=0.03)


def test_without_the_filter_the_last_keyframe_decides():
    estimator = ScaleEstimator(CONFIG, ("kalman",))
    play(estimator, 10)
    keyframe = keyframe_of_wall(10, 4.0)
    answer, _ = estimator.process(keyframe, depth_of(keyframe, 1.3))
    assert answer.log_scale == pytest.approx(np.log(1.3), abs=0.01)


def test_without_the_least_squares_outliers_count():
    wrong = slice(0, 60)
    values = {}
    for ablate in ((), ("wls",)):
        keyframe = keyframe_of_wall(1, 0.4)
        keyframe.depths[wrong] *= 20.0
        values[ablate] = ScaleEstimator(CONFIG, ablate).process(keyframe, depth_of(keyframe))[0].observation
    assert abs(values[()]) < 0.2
    assert values["wls",] == pytest.approx(-0.3 * np.log(20.0), abs=0.01)


BAD_DEPTHS = {
    "all NaN": lambda depth: replace(depth, depth=np.full_like(depth.depth, np.nan)),
    "zeros": lambda depth: replace(depth, depth=np.zeros_like(depth.depth)),
    "negative": lambda depth: replace(depth, depth=-depth.depth),
    "infinite": lambda depth: replace(depth, depth=np.full_like(depth.depth, np.inf)),
    "constant": lambda depth: replace(depth, depth=np.full_like(depth.depth, 3.0)),
    "ten times": lambda depth: replace(depth, depth=depth.depth * 10),
    "empty": lambda depth: replace(depth, depth=np.zeros((0, 0), np.float32)),
    "invalid": lambda depth: replace(depth, valid=False),
    "bent placement": lambda depth: replace(depth, image_to_depth=np.full(4, np.nan)),
    "no bias": lambda depth: replace(depth, bias_sigma=float("nan")),
    "none": lambda depth: None,
}


@pytest.mark.parametrize("spoil", BAD_DEPTHS.values(), ids=BAD_DEPTHS)
@pytest.mark.parametrize("start", [0, 15])
@pytest.mark.parametrize("ablate", [(), ("kalman", "wls")], ids=["whole", "ablated"])
def test_bad_depth_gives_no_nonsense_and_is_recovered_from(spoil, start, ablate):
    estimator = ScaleEstimator(CONFIG, ablate)
    for k in range(start + 60):
        keyframe = keyframe_of_wall(k, k * 0.4)
        depth = depth_of(keyframe)
        scale, _ = estimator.process(keyframe, spoil(depth) if start <= k < start + 4 else depth)
        numbers = [scale.log_scale, scale.sigma, scale.filter_sigma]
        assert np.isfinite(numbers).all()
        assert scale.sigma > 0
        assert not (scale.accepted and np.isnan(scale.observation))
    assert abs(scale.log_scale) < 0.15
    assert scale.accepted


def test_a_camera_that_cannot_be_is_no_observation():
    keyframe = replace(keyframe_of_wall(0, 0.0), camera=np.array([640.0, 480.0, -1.0, 500.0, 320.0, 240.0]))
    scale, gate = ScaleEstimator(CONFIG).process(keyframe, depth_of(keyframe))
    assert scale.points == 0
    assert len(gate.weights) == 200


def test_a_distorted_camera_is_looked_up_where_the_network_saw_it():
    camera = Camera(640, 480, 500.0, 500.0, 319.5, 239.5, distortion=(-0.25, 0.08, 0.001, -0.002))
    keyframe = keyframe_of_wall(1, 0.4, metres_per_unit=0.7, camera=camera)
    scale, _ = ScaleEstimator(CONFIG).process(keyframe, depth_of(keyframe, camera=camera))
    assert scale.observation == pytest.approx(np.log(0.7), abs=1e-4)


def test_a_source_that_knows_how_well_its_images_agree_is_believed_accordingly():
    """The first depth fixes the unit as well as its pixels' common error allows."""
    estimators = [ScaleEstimator(ScaleConfig()) for _ in range(2)]
    first = keyframe_of_wall(0, 0.0, parallax_deg=0.0)
    plain, sure = (
        estimator.process(first, replace(depth_of(first), frame_sigma=sigma))[0]
        for estimator, sigma in zip(estimators, (np.nan, 0.02), strict=True)
    )
    assert sure.filter_sigma < 0.5 * plain.filter_sigma
    for k in range(1, 10):
        later = keyframe_of_wall(k, 0.4 * k, metres_per_unit=1.03)
        sure = estimators[1].process(later, replace(depth_of(later), frame_sigma=0.02))[0]
    assert sure.filter_sigma < 0.05
    for nonsense in (-1.0, np.inf, np.nan, 50.0):
        scale = estimators[1].process(later, replace(depth_of(later), frame_sigma=nonsense))[0]
        assert np.isfinite(scale.filter_sigma)


def test_sigma_has_the_network_s_bias_and_what_is_held_back():
    estimator = ScaleEstimator(ScaleConfig())
    free = ScaleEstimator(CONFIG)
    for held, best in zip(play(estimator, 40, 1.3), play(free, 40, 1.3), strict=True):
        expected = np.hypot(np.hypot(best.filter_sigma, 0.1), held.log_scale - best.log_scale)
        assert held.sigma == pytest.approx(expected)
        assert held.bias_sigma == 0.1
    assert held.log_scale != best.log_scale


def test_a_network_whose_images_disagree_by_more_than_it_is_known_for_may_be_off_by_a_factor():
    estimator = ScaleEstimator(CONFIG)
    results = play(estimator, 60, 1.02, waver=0.6)
    assert results[0].sigma < 0.25
    for scale in results:
        beyond = np.sqrt(max(scale.sigma**2 - scale.filter_sigma**2 - 0.1**2, 0.0))
        assert beyond <= 2.0 + 1e-9
    assert beyond == pytest.approx(2.0)
    assert scale.bias_sigma == 0.1, "the card's"
    # A part of the map that begins is seen by the same network.
    apart = replace(keyframe_of_wall(60, 24.0, 1.02, parallax_deg=0.0), part=60)
    assert estimator.process(apart, depth_of(apart))[0].sigma > 2.0


def test_another_network_is_not_lost_for_the_one_before_and_has_its_own_metres():
    estimator = ScaleEstimator(CONFIG)
    play(estimator, 60, 1.02, waver=0.6)
    for k in range(60, 64):
        keyframe = keyframe_of_wall(k, k * 0.4, 1.02)
        right = replace(depth_of(keyframe, 3.0), bias_sigma=0.1, model="another")
        scale = estimator.process(keyframe, right)[0]
    assert scale.log_scale == pytest.approx(np.log(3.06), abs=0.1)
    assert scale.sigma < 0.3


def test_a_steadier_network_makes_nothing_surer_that_was_known_before_it():
    estimator = ScaleEstimator(CONFIG)
    known = play(estimator, 20)[-1].filter_sigma
    later = keyframe_of_wall(20, 8.0)
    steadier = replace(depth_of(later), valid=False, bias_sigma=0.05, model="steadier")
    scale = estimator.process(later, steadier)[0]
    assert scale.filter_sigma == pytest.approx(np.hypot(known, np.hypot(0.1, 0.05)), rel=0.02)
    assert estimator._filter._spread.sigma == pytest.approx(0.5 * 0.15)


def test_a_sensor_is_never_lost():
    estimator = ScaleEstimator(CONFIG)
    for k in range(100):
        keyframe = keyframe_of_wall(k, k * 0.4, parallax_deg=3.0 if k else 0.0)
        depth = replace(depth_of(keyframe, np.exp(0.3 * np.sin(0.3 * k))), bias_sigma=0.01, frame_sigma=0.06)
        scale = estimator.process(keyframe, depth)[0]
    assert estimator.doubt
    assert scale.sigma == pytest.approx(np.hypot(scale.filter_sigma, 0.01))


@pytest.mark.parametrize(("bias", "waver"), [(0.02, 0.0), (0.1, 0.0), (0.1, 0.6)])
def test_what_is_held_back_goes_with_what_was_learned(bias, waver, monkeypatch):
    """Of a network that is steadier than the model, of one like it, and of a wilder one."""
    best = play(ScaleEstimator(CONFIG), 60, 1.02, bias=bias, waver=waver)
    followed = []
    monkeypatch.setattr(SteadyScale, "follow", lambda _, *told: followed.append(told))
    play(ScaleEstimator(ScaleConfig()), 60, 1.02, bias=bias, waver=waver)
    estimates, sigmas, excess = (np.array(column) for column in zip(*followed[::2], strict=True))
    assert estimates == pytest.approx([scale.log_scale for scale in best])
    assert sigmas == pytest.approx([np.hypot(scale.filter_sigma, bias) for scale in best])
    assert excess[0] == 1.0
    assert excess[-1] > 1.5 if waver else np.all(excess == 1.0)
    of_map, modest = (np.array(column) for column in zip(*followed[1::2], strict=True))
    assert np.all(of_map == estimates)
    assert np.all(modest <= sigmas)
    assert (modest[-1] < 0.8 * sigmas[-1]) == bool(waver), "the map's has no more room than the model's"


def test_however_long_the_published_scale_is_held_the_map_is_built_by_the_same():
    held, usual = (play(ScaleEstimator(ScaleConfig(hold_sigmas=k)), 60, 1.12) for k in (3.0, 0.6))
    assert held[-1].log_scale == 0.0 < 0.02 < usual[-1].log_scale
    of_map = [scale.map_log_scale for scale in usual]
    assert [scale.map_log_scale for scale in held] == of_map
    assert of_map[-1] == usual[-1].log_scale, "of a network that is as the model has it"


def test_a_network_with_less_bias_is_thought_to_spread_less():
    keyframe = keyframe_of_wall(0, 0.0, 1.0, parallax_deg=0.0)
    usual = ScaleEstimator(CONFIG).process(keyframe, depth_of(keyframe))[0]
    better = ScaleEstimator(CONFIG).process(keyframe, replace(depth_of(keyframe), bias_sigma=0.05))[0]
    assert better.filter_sigma == pytest.approx(0.5 * usual.filter_sigma)


def test_the_scale_here_fades_by_time_that_has_passed_once():
    """A depth that came late does not set the clock back."""
    said = []
    for late in (False, True):
        estimator = ScaleEstimator(ScaleConfig())
        play(estimator, 20)
        play(estimator, 5, metres_per_unit=1.5, start=21)
        if late:
            keyframe = keyframe_of_wall(15, 6.0, 1.5)
            assert estimator.process(keyframe, depth_of(keyframe))[0].accepted
        said.append(estimator._parts.here.local_ns)
    assert said[0] == said[1]


def test_a_place_whose_scale_is_another_is_told_from_the_network_s_errors():
    estimator = ScaleEstimator(ScaleConfig())
    assert [r.local_sigma for r in play(estimator, 20)] == [0.0] * 20
    there = play(estimator, 9, metres_per_unit=1.5, start=21)[-1]  # a part of the map that is too small
    seen = abs(there.observation - there.log_scale)
    assert seen > 0.25
    assert 0.5 * seen < there.local_sigma < seen
    assert play(estimator, 1, start=50, epoch=1)[0].local_sigma == 0.0


def test_trust_counts_by_how_it_compares_with_the_best():
    """A tracker that trusts all of its points little has said which it trusts more all the same."""
    found = []
    for most in (1.0, 0.02):
        keyframe = keyframe_of_wall(0, 0.0, 1.0)
        doubted = np.arange(len(keyframe.depths)) % 2 == 0
        depths = np.where(doubted, 1.1, 1.0).astype(np.float32) * keyframe.depths
        trust = np.where(doubted, 0.1 * most, most).astype(np.float32)
        told = replace(keyframe, depths=depths, trust=trust)
        found.append(ScaleEstimator(CONFIG).process(told, depth_of(keyframe))[0].observation)
    assert found[0] == pytest.approx(0.0, abs=0.02)  # half of the way between is 0.048
    assert found[1] == pytest.approx(found[0])
