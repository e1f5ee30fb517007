"""Depth by pictures against a room whose depth is exact."""

from __future__ import annotations

import numpy as np

from prism_edge.reconstruction.sweep import MOST_OTHERS, SPAN, _best_two, corrected, sweep, with_baseline
from tests.reconstruction.room import all_others, log_errors, looks, wavering


def beside(number: int) -> list:
    return with_baseline(looks()[number], [looks()[j] for j in all_others()[number]])


def test_the_room_is_seen_from_places_that_tell_depth() -> None:
    assert all(beside(k) for k in looks())


def test_depth_that_is_off_is_brought_back_where_pictures_say_so() -> None:
    for number in (1, 4):
        off = wavering(looks()[number])
        found = sweep(off, beside(number))
        before = log_errors(off.view.depth, number)
        assert found.sure.mean() > 0.15
        left = before[found.sure.ravel()] + found.log_depth[found.sure]
        assert np.median(np.abs(before)) > 0.02
        assert np.median(np.abs(left)) < 0.006
        after = log_errors(corrected(off, found).view.depth, number)
        assert np.median(np.abs(after)) < 0.4 * np.median(np.abs(before)), "those between follow"


def test_depth_that_is_right_stays() -> None:
    exact = looks()[3]
    after = log_errors(corrected(exact, sweep(exact, beside(3))).view.depth, 3)
    assert np.median(np.abs(after)) < 0.004
    assert np.percentile(np.abs(after), 95) < 0.05


def test_pictures_that_show_nothing_say_nothing() -> None:
    blank = [look.__class__(look.view, np.full_like(look.grey, 90), look.colours) for look in beside(2)]
    exact = looks()[2]
    for found in (sweep(exact, blank), sweep(blank[0], blank[1:])):
        assert not found.sure.any()
    kept = corrected(exact, sweep(exact, blank))
    np.testing.assert_array_equal(kept.view.depth, exact.view.depth)


def test_what_is_beyond_the_span_is_not_sure() -> None:
    """No depth that was tried is right: most of what looks alike is left at an end, or like others."""
    exact = looks()[1]
    far_off = exact.with_depth(exact.view.depth * np.float32(np.exp(3 * SPAN)))
    assert sweep(far_off, beside(1)).sure.mean() < 0.2 * sweep(exact, beside(1)).sure.mean()


def test_a_camera_that_stood_still_tells_no_depth() -> None:
    exact = looks()[0]
    assert with_baseline(exact, [exact, exact]) == []
    assert with_baseline(exact.with_depth(np.zeros_like(exact.view.depth)), [looks()[1]]) == []
    assert len(with_baseline(looks()[3], [looks()[j] for j in (1, 2, 4, 5, 6, 7)] * 3)) <= MOST_OTHERS


def test_pixels_without_depth_stay_without() -> None:
    exact = looks()[4]
    holed = exact.view.depth.copy()
    holed[30:60, 40:90] = 0.0
    found = sweep(exact.with_depth(holed), beside(4))
    assert not found.sure[30:60, 40:90].any()
    assert np.isfinite(found.log_depth).all()
    assert (corrected(exact.with_depth(holed), found).view.depth[30:60, 40:90] == 0).all()


def test_of_those_asked_the_two_most_alike_count_in_whatever_order_they_come() -> None:
    said = np.random.default_rng(0).uniform(-1.0, 1.0, (5, 3, 40, 40)).astype(np.float32)
    ascending = np.sort(said, axis=0)
    for order in (said, ascending, ascending[::-1]):
        np.testing.assert_allclose(_best_two(iter(order)), ascending[-2:].mean(axis=0), atol=1e-6)
    np.testing.assert_array_equal(_best_two([said[0]]), said[0])
