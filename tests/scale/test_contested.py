"""Observations refused in a row that agree: they or the estimate are wrong, and sigma says so."""

from __future__ import annotations

import numpy as np
import pytest

from prism_edge.scale.estimator import ScaleEstimator
from prism_edge.scale.filter import CONTESTED_AFTER, REOPEN_AFTER, ScaleFilter
from tests.scale.test_estimator import CONFIG, play
from tests.scale.test_filter import STILL, played, seen

OFF = float(np.log(10.0))


def refused(scale: ScaleFilter, observations: list[float]) -> list[float]:
    """What is contested after each of them."""
    told = []
    for k, z in enumerate(observations):
        scale.predict(40.0 + 0.3 * k, 0.0)
        assert not scale.update(seen(z))
        told.append(scale.contested_sigma)
    return told


def test_the_more_agree_the_more_an_estimate_is_in_doubt() -> None:
    scale = played(np.arange(12) * 0.3, np.zeros(12), unit=False)
    known = scale.log_scale, scale.sigma
    told = refused(scale, [OFF + 0.01 * (-1) ** k for k in range(11)])
    few = CONTESTED_AFTER - 1
    assert told[:few] == [0.0] * few, "one or two are outliers like any"
    assert told[few:] == pytest.approx([OFF * n / 12 for n in range(CONTESTED_AFTER, 12)], rel=0.02)
    assert scale.log_scale == known[0]
    assert scale.sigma == pytest.approx(known[1], rel=0.2)
    assert scale.update(seen(0.0))
    assert scale.contested_sigma == 0.0, "the estimate was right"


def test_once_it_has_fallen_nothing_is_contested() -> None:
    scale = played(np.arange(3) * 0.3, np.zeros(3), unit=False)
    assert refused(scale, [OFF] * (REOPEN_AFTER[0] - 1))[-1] > 1.0
    assert scale.update(seen(OFF))
    assert scale.contested_sigma == 0.0
    assert scale.log_scale == pytest.approx(OFF, abs=0.1)


def test_those_that_contradict_each_other_put_nothing_in_doubt() -> None:
    scale = played(np.arange(20) * 0.3, np.zeros(20))
    assert not any(refused(scale, [2.0, -2.0, 4.0, -4.0, 2.0, -2.0]))


def test_of_such_the_latest_that_agree_count() -> None:
    """A map that breaks may be of one size after the other until it is of its last."""
    scale = played(np.arange(20) * 0.3, np.zeros(20), unit=False)
    told = refused(scale, [1.0, 1.0, 3.0, 3.0, 3.0, 3.0])
    assert told[-1] == pytest.approx(3.0 * 4 / 20, rel=0.05)


def test_a_stray_one_among_them_takes_no_doubt_away() -> None:
    scale = played(np.arange(12) * 0.3, np.zeros(12), unit=False)
    told = refused(scale, [OFF] * 8 + [-OFF])
    assert told[-1] == told[-2] > 1.0


def test_another_network_s_metres_are_another_matter() -> None:
    scale = played(np.arange(12) * 0.3, np.zeros(12), unit=False)
    refused(scale, [OFF] * 8)
    scale.meet_another(0.1, 0.15, STILL)
    assert scale.contested_sigma == 0.0
    told = refused(scale, [OFF] * CONTESTED_AFTER)
    assert told[:-1] == [0.0] * (CONTESTED_AFTER - 1)


def test_a_part_that_joins_leaves_the_doubt_as_it_is() -> None:
    """Whichever was seen last."""
    for late in (0.0, 100.0):
        home = played(np.arange(12) * 0.3, np.zeros(12), unit=False)
        refused(home, [OFF] * 8)
        part = played(late + np.arange(12) * 0.3, np.zeros(12), unit=False)
        assert home.joined(part, 0.0, 0.01).contested_sigma == home.contested_sigma > 1.0


def test_the_published_sigma_has_it() -> None:
    estimator = ScaleEstimator(CONFIG)
    before = play(estimator, 20)[-1]
    later = play(estimator, 10, factor=10.0, start=20)[1:]  # the first of them is seen without parallax
    assert not any(one.accepted for one in later)
    assert later[-1].log_scale == pytest.approx(before.log_scale)
    assert later[-1].sigma > 3.0 * before.sigma
    assert later[-1].sigma == pytest.approx(np.hypot(before.sigma, OFF * len(later) / 20), rel=0.1)
    assert play(estimator, 2, start=30)[-1].sigma == pytest.approx(before.sigma, rel=0.2)
