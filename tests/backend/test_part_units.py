"""Metres of a map's parts, before and after a loop has joined two of them."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import pytest

from prism_edge.backend.map_scale import KnownScale
from prism_edge.backend.part_units import MOST, PartUnits
from prism_edge.errors import MapError
from prism_edge.messages import HOME, Scale

A_SCALE = Scale(0, 0, 0, 9.0, 0.0, 0.1, 0.0, math.nan, math.nan, 0, False)


def told(part: int, map_log_scale: float, **sigmas: float) -> Scale:
    return replace(A_SCALE, part=part, map_log_scale=map_log_scale, **sigmas)


def units_of(home: KnownScale) -> PartUnits:
    units = PartUnits()
    units.begin(home)
    return units


def test_the_part_that_was_spoken_of_last_counts():
    units = units_of(KnownScale(0.25))
    assert units.log_scale == 0.25
    units.hear(told(7, 0.9))
    assert units.log_scale == 0.9
    units.hear(told(HOME, 0.3))
    assert units.log_scale == 0.3


def test_of_parts_begun_for_hours_the_newest_are_known():
    units = units_of(KnownScale(0.25))
    for part in range(1, 3 * MOST):
        units.hear(told(part, 0.001 * part, filter_sigma=0.1, bias_sigma=0.0, lost_sigma=0.0))
    newest = 3 * MOST - 1
    assert units.log_scale == pytest.approx(0.001 * newest)
    assert units.between(newest, newest - MOST // 2) is not None
    assert units.between(newest, 1) is None
    units.go_home()
    assert units.log_scale == 0.25


def test_what_is_told_of_a_part_that_was_joined_is_of_a_unit_that_is_no_more():
    units = PartUnits()
    units.hear(told(HOME, 0.1))
    units.hear(told(7, 0.9))
    units.join(7, HOME, 0.8)
    assert units.log_scale == 0.1
    units.hear(told(7, 0.95))
    assert units.log_scale == 0.1
    units.hear(told(HOME, 0.12))
    assert units.log_scale == 0.12


@pytest.mark.parametrize("ends", [(9, 7), (7, 9), (9, HOME)])
def test_a_part_joined_to_one_that_was_never_told_of_brings_its_metres(ends):
    units = PartUnits()
    units.hear(told(9, 0.9))
    units.join(*ends, 0.5)  # what is 1 in the newer is exp(0.5) in the older
    assert units.log_scale == pytest.approx(0.4)
    units.hear(told(9, 2.0))
    assert units.log_scale == pytest.approx(0.4)


def test_parts_are_joined_one_after_the_other_in_any_order():
    units = PartUnits()
    for part, log_scale in ((HOME, 0.0), (4, 0.4), (8, 0.8)):
        units.hear(told(part, log_scale))
    units.join(4, 8, 0.4)
    assert units.log_scale == 0.4
    units.join(8, HOME, 0.4)  # which is 4 by now
    assert units.log_scale == 0.0
    units.join(4, 8, 0.0)
    units.hear(told(4, 0.5))
    assert units.log_scale == 0.0


def test_one_unit_in_another_is_known_as_well_as_both_parts_metres():
    units = PartUnits()
    units.hear(told(HOME, 0.1, filter_sigma=0.03, bias_sigma=0.04))
    units.hear(told(7, 0.4, filter_sigma=0.12, bias_sigma=0.0, lost_sigma=0.0))
    assert units.between(7, HOME) == pytest.approx((0.3, math.hypot(0.05, 0.12)))
    assert units.between(HOME, 7) == pytest.approx((-0.3, math.hypot(0.05, 0.12)))
    assert units.between(7, 7) is units.between(7, 9) is None
    units.hear(told(7, 0.4, lost_sigma=2.0))
    assert units.between(7, HOME)[1] > 2.0
    units.join(7, HOME, 0.3)
    assert units.between(7, HOME) is None


@pytest.mark.parametrize("sigma", [math.nan, math.inf])
def test_of_metres_whose_sigma_nobody_knows_no_ratio_follows(sigma):
    units = PartUnits()
    units.hear(told(7, 0.9, filter_sigma=0.05))
    assert units.between(7, HOME) is None, "the first part's sigma was not told"
    units.hear(told(HOME, 0.1, filter_sigma=sigma))
    assert units.between(7, HOME) is None
    assert units.log_scale == 0.1


@pytest.mark.parametrize(("known", "sigma"), [(KnownScale(0.2, 0.03, 0.04), 0.05), (KnownScale(), None)])
def test_a_map_that_was_there_before_knows_its_metres_as_well_as_it_says(known: KnownScale, sigma):
    units = units_of(known)
    assert units.log_scale == known.log_scale
    units.hear(told(7, 0.9, filter_sigma=0.12))
    wanted = None if sigma is None else pytest.approx((0.7, math.hypot(0.12, sigma)))
    assert units.between(7, HOME) == wanted


def test_another_life_goes_on_with_what_a_journal_says_of_the_parts_that_there_are():
    units = units_of(KnownScale(0.1, 0.05))
    for part, log_scale in ((4, 0.4), (6, 0.6), (8, 0.8)):
        units.hear(told(part, log_scale, filter_sigma=0.03))
    units.join(8, 6, 0.2)
    info = json.loads(json.dumps(units.info([None, HOME, 6, 8, 8])))
    again = units_of(KnownScale(0.1, 0.05))
    again.take(info)
    assert again.log_scale == units.log_scale == 0.6, "the camera is in the joined part"
    assert again.between(6, HOME) == units.between(6, HOME)
    assert again.between(8, HOME) == units.between(8, HOME), "joined to the sixth"
    assert again.between(4, HOME) is None, "of which no keyframe is left"
    again.go_home()
    assert again.log_scale == 0.1
    again.begin(KnownScale())
    again.take({})  # an earlier build's
    assert again.log_scale == 0.0


@pytest.mark.parametrize(
    "wrong",
    [
        {"units": 3},
        {"units": [[HOME, 0.1]]},
        {"units": [[HOME, "0.1", 0.2]]},
        {"units": [[HOME, 1e9, 0.2]]},
        {"units": [[HOME, 0.1, -0.2]]},
        {"units": [[True, 0.1, 0.2]], "unit_of": 1},
        {"units": [[False, 0.1, 0.2]], "unit_of": 0},
        {"joined_units": [[4, 5]]},
        {"joined_units": [[5, 5]]},
        {"joined_units": [[5, -2]]},
        {"joined_units": None},
        {"unit_of": 7},
        {"unit_of": None},
        {"unit_of": [HOME]},
    ],
)
def test_units_that_cannot_be_are_refused_and_change_nothing(wrong: dict[str, object]):
    units = units_of(KnownScale(0.1))
    with pytest.raises(MapError, match="units"):
        units.take(units_of(KnownScale(0.7)).info([]) | wrong)
    assert units.log_scale == 0.1
