"""Parts of a map have units of their own: what is seen in one says nothing of another's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from prism_edge.config import ScaleConfig
from prism_edge.messages import HOME
from prism_edge.scale import parts
from prism_edge.scale.estimator import ScaleEstimator
from tests.scale.scene import depth_of, keyframe_of_wall

CONFIG = ScaleConfig(hold_sigmas=0.0)
FITTED = {"dsug_tau": 0.2, "dsug_temperature": 0.05}


def play(estimator, numbers, part=HOME, unit=1.0, **changes):
    """Keyframes of a part in units of so many metres; one that begins a map or a part has only seeds."""
    said = []
    for k in numbers:
        parallax = 0.0 if k in (0, part) else 3.0
        keyframe = replace(keyframe_of_wall(k, 0.4 * k, unit, parallax_deg=parallax), part=part)
        said.append(estimator.process(keyframe, depth_of(keyframe, **{**FITTED, **changes})))
    return [scale for scale, _ in said]


def at_home(unit=1.1):
    """An estimator that has seen the map's first part for long, and what it said."""
    estimator = ScaleEstimator(CONFIG)
    return estimator, play(estimator, range(60), unit=unit)


def test_a_new_part_begins_at_what_was_published_as_little_known_as_any_first_depth():
    estimator, home = at_home()
    (begins,) = play(estimator, [60], part=60)
    assert (begins.part, begins.metric) == (60, True)
    assert begins.log_scale == pytest.approx(home[-1].log_scale)
    first = np.hypot(CONFIG.frame_sigma, CONFIG.point_sigma / np.sqrt(CONFIG.min_points))
    assert begins.filter_sigma == pytest.approx(first, rel=1e-6)
    assert begins.filter_sigma > 2.0 * home[-1].filter_sigma
    there = play(estimator, range(61, 120), part=60, unit=1.5)
    assert there[-1].log_scale == pytest.approx(np.log(1.5), abs=0.04)


def test_a_new_part_begins_in_the_unit_that_the_tracker_had_wherever_the_camera_was_last_heard_of():
    """At home again, in a known place, no keyframe is made: the next part begins from there all the same."""
    estimator, home = at_home()
    there = play(estimator, range(60, 100), part=60, unit=1.6)
    keyframe = keyframe_of_wall(200, 80.0, 1.1, parallax_deg=0.0)
    told = replace(keyframe, part=200, log_scale=home[-1].log_scale)
    begins, _ = estimator.process(told, depth_of(keyframe, **FITTED))
    assert begins.log_scale == pytest.approx(home[-1].log_scale)
    assert abs(there[-1].log_scale - home[-1].log_scale) > 0.2


def test_back_at_home_nothing_of_the_part_is_left_in_its_scale():
    estimator, home = at_home()
    play(estimator, range(60, 90), part=60, unit=1.5)
    back = play(estimator, range(90, 95), unit=1.1)
    assert back[0].part == HOME
    assert back[0].log_scale == pytest.approx(home[-1].log_scale, abs=2e-3)
    assert back[0].filter_sigma < 1.2 * home[-1].filter_sigma
    again = play(estimator, [95], part=60, unit=1.5)[0]  # and the part is known as it was
    assert again.log_scale == pytest.approx(np.log(1.5), abs=0.05)
    assert estimator.accepted == 59 + 29 + 5 + 1


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("depth", ["at once", "late", "never"])
def test_joined_parts_know_what_either_did(known, depth):
    """Lost after two seconds, mapped for longer, and home again: what was learned meanwhile counts."""
    estimator = ScaleEstimator(CONFIG)
    home = play(estimator, range(6), unit=1.3)
    there = play(estimator, range(30, 120), part=30, unit=1.5)
    joined, units = np.array([[30, HOME]]), np.array([[np.log(1.5 / 1.3), 0.002 if known else np.inf]])
    keyframe = replace(keyframe_of_wall(120, 48.0, 1.3), joined=joined, joined_units=units)
    estimator.hear(keyframe)
    if depth == "late":
        estimator.process(keyframe, None)  # how unsure it is meanwhile
    elif depth == "never":
        keyframe = keyframe_of_wall(121, 48.4, 1.3)
        estimator.hear(keyframe)
    back, _ = estimator.process(keyframe, depth_of(keyframe, **FITTED))
    assert back.part == HOME
    assert estimator._filter.accepted == (5 + 89 if known else 5) + 1
    assert (abs(back.log_scale - np.log(1.3)) < 0.03) == known
    assert (back.filter_sigma < 1.05 * there[-1].filter_sigma) == known
    assert back.filter_sigma < 1.05 * home[-1].filter_sigma


def test_a_part_that_joins_one_of_which_nothing_is_known_brings_what_is_known_into_its_unit():
    estimator = ScaleEstimator(CONFIG)
    (open_yet,) = play(estimator, [0], unit=2.0, valid=False)
    assert not open_yet.metric
    there = play(estimator, range(30, 90), part=30, unit=1.5)
    joined, units = np.array([[30, HOME]]), np.array([[-np.log(2.0), 0.01]])
    keyframe = replace(keyframe_of_wall(90, 36.0, 3.0), joined=joined, joined_units=units)
    estimator.hear(keyframe)
    back, _ = estimator.process(keyframe, None)
    assert back.metric
    assert back.log_scale == pytest.approx(there[-1].log_scale + np.log(2.0), abs=0.01)


@pytest.mark.parametrize("depth", [None, "unusable"])
def test_a_part_that_had_no_depth_leaves_no_trace(depth):
    estimator, home = at_home()
    keyframe = replace(keyframe_of_wall(60, 24.0, parallax_deg=0.0), part=60)
    given = None if depth is None else replace(depth_of(keyframe), valid=False)
    scale, _ = estimator.process(keyframe, given)
    assert (scale.log_scale, scale.metric) == (pytest.approx(home[-1].log_scale), False)
    assert play(estimator, [61], unit=1.1)[0].log_scale == pytest.approx(home[-1].log_scale, abs=2e-3)
    (later,) = play(estimator, [62], part=62)
    assert later.log_scale == pytest.approx(home[-1].log_scale, abs=2e-3)


def test_what_a_scale_process_that_was_started_again_takes_over_is_of_the_map_s_first_part():
    """The backend and a stored map tell of that one's unit, wherever the camera is by then."""
    estimator = ScaleEstimator(CONFIG)
    estimator.take_over(0, np.log(1.5), 0.02, bias_sigma=0.1)
    there = play(estimator, range(90, 120), part=60, unit=1.1)
    assert there[0].filter_sigma > 0.1
    assert there[-1].log_scale == pytest.approx(np.log(1.1), abs=0.05)
    (home,) = play(estimator, [120], unit=1.5)
    assert home.filter_sigma < 0.03
    assert home.log_scale == pytest.approx(np.log(1.5), abs=0.01)


def test_a_part_that_begins_in_a_map_that_was_taken_over_is_not_that_map():
    estimator = ScaleEstimator(CONFIG)
    estimator.take_over(0, np.log(1.5), 0.02, bias_sigma=0.1)
    (begins,) = play(estimator, [90], part=90)
    assert begins.filter_sigma > 0.1
    assert begins.log_scale == pytest.approx(np.log(1.5))
    play(estimator, range(91, 120), part=90, unit=1.1)
    (home,) = play(estimator, [120], unit=1.5)
    assert home.log_scale == pytest.approx(np.log(1.5), abs=0.01)


def test_the_way_that_was_gone_elsewhere_is_no_doubt_of_home():
    sigmas = []
    for way in (0.0, 1000.0):
        estimator, _ = at_home()
        play(estimator, range(60, 63), part=60)
        back = replace(keyframe_of_wall(63, 0.4 * 63, 1.1), travelled=way)
        sigmas.append(estimator.process(back, None)[0].filter_sigma)
        later = replace(keyframe_of_wall(64, 0.4 * 64, 1.1), travelled=way + 1000.0)
        sigmas.append(estimator.process(later, None)[0].filter_sigma)
    assert sigmas[2] == sigmas[0], "time passed there as well"
    assert sigmas[1] == sigmas[3] > 1.5 * sigmas[0], "the way at home counts on"


def test_of_parts_without_end_the_oldest_are_forgotten(monkeypatch):
    """A camera before what can't be tracked begins one every few seconds."""
    monkeypatch.setattr(parts, "MOST", 3)
    estimator, home = at_home()
    for part in range(60, 80, 2):
        play(estimator, range(part, part + 2), part=part, unit=1.5)
    assert len(list(estimator._parts)) == 3 + 1
    assert (estimator.accepted, estimator.rejected) == (59 + 10, 0), "what was counted there still is"
    (again,) = play(estimator, [80], part=76, unit=1.5)
    assert again.filter_sigma < 0.2, "the newest are known"
    (back,) = play(estimator, [81], unit=1.1)
    assert back.log_scale == pytest.approx(home[-1].log_scale, abs=2e-3)
    estimator.begin(1)
    assert (estimator.accepted, estimator.rejected) == (0, 0)


def test_parts_that_had_no_depth_make_none_forgotten_that_had(monkeypatch):
    """Nothing is known of them: they take no place of those of which something is."""
    monkeypatch.setattr(parts, "MOST", 3)
    estimator, _ = at_home()
    there = play(estimator, range(60, 90), part=60, unit=1.5)
    for part in range(90, 100):
        play(estimator, [part], part=part, valid=False)
    (again,) = play(estimator, [100], part=60, unit=1.5)
    assert again.filter_sigma < 1.2 * there[-1].filter_sigma
    assert again.log_scale == pytest.approx(there[-1].log_scale, abs=0.02)


def test_another_network_puts_all_parts_in_doubt():
    sigmas = []
    for model in ("wall", "another"):
        estimator, _ = at_home()
        play(estimator, range(60, 63), part=60, model=model)
        sigmas.append(play(estimator, [63], model=model, valid=False)[0].filter_sigma)
    assert sigmas[1] > 2.0 * sigmas[0]


def test_a_new_epoch_forgets_the_parts():
    estimator, _ = at_home()
    play(estimator, range(60, 63), part=60)
    first = keyframe_of_wall(70, 28.0, epoch=1, parallax_deg=0.0)
    assert estimator.process(first, depth_of(first))[0].log_scale == 0.0


def test_views_of_one_part_are_not_held_against_another():
    estimator, _ = at_home()
    seen = {}
    for k, part in ((60, HOME), (61, 61), (62, 61), (63, HOME)):
        keyframe = replace(keyframe_of_wall(k, 0.4 * k, 1.1), part=part)
        if k == 61:
            estimator.hear(keyframe)  # while views of the old part are at hand
        seen[k] = estimator.process(keyframe, depth_of(keyframe, **FITTED))[1]
    assert np.isfinite(seen[60].uncertainty).mean() > 0.9
    for k in (61, 63):
        assert np.isnan(seen[k].uncertainty).all()
        assert np.all(seen[k].weights == 1.0)
    assert np.isfinite(seen[62].uncertainty).mean() > 0.9
