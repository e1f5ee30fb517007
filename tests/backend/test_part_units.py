"""Metres of a map's parts, before and after a loop has joined two of them."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from prism_edge.backend.map_scale import KnownScale
from prism_edge.backend.part_units import PartUnits
from prism_edge.messages import HOME, Scale

A_SCALE = Scale(0, 0, 0, 9.0, 0.0, 0.1, 0.0, math.nan, math.nan, 0, False)


def told(part: int, map_log_scale: float, **sigmas: float) -> Scale:
    return replace(A_SCALE, part=part, map_log_scale=map_log_scale, **sigmas)


def test_the_part_that_was_spoken_of_last_counts():
    units = PartUnits(0.25)
    assert units.log_scale == 0.25
    units.hear(told(7, 0.9))
    assert units.log_scale == 0.9
    units.hear(told(HOME, 0.3))
    assert units.log_scale == 0.3


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


@pytest.mark.parametrize("ends", [(9, 7), (7, 9)])
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
    units = PartUnits(0.2)
    units.hear(told(7, 0.9, filter_sigma=0.05))
    assert units.between(7, HOME) is None, "the first part's sigma was not told"
    units.hear(told(HOME, 0.1, filter_sigma=sigma))
    assert units.between(7, HOME) is None
    assert units.log_scale == 0.1


@pytest.mark.parametrize(("known", "sigma"), [(KnownScale(0.2, 0.03, 0.04), 0.05), (KnownScale(), None)])
def test_a_map_that_was_there_before_knows_its_metres_as_well_as_it_says(known: KnownScale, sigma):
    units = PartUnits.of(known)
    assert units.log_scale == known.log_scale
    units.hear(told(7, 0.9, filter_sigma=0.12))
    wanted = None if sigma is None else pytest.approx((0.7, math.hypot(0.12, sigma)))
    assert units.between(7, HOME) == wanted
