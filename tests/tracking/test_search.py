"""How long a lost camera has looked about, and when images have failed to come for too long."""

from __future__ import annotations

import pytest

from prism_edge.tracking.motion import LONGEST_S
from prism_edge.tracking.search import LAPSE, MOST_BETWEEN_NS, Search

MS = 1_000_000


def lapses(*intervals_ms: float) -> list[bool]:
    search = Search()
    return [search.lapsed(round(ms * MS)) for ms in intervals_ms]


def test_a_gap_that_no_motion_reaches_over_is_a_lapse() -> None:
    assert lapses(33, 33, LONGEST_S * 990, 33, LONGEST_S * 1010, 33) == [False] * 4 + [True, False]


def test_of_a_slow_camera_all_images_are_far_apart() -> None:
    assert lapses(33, *[1000] * 5, 1000 * LAPSE * 0.99)[2:] == [False] * 5
    assert lapses(33, *[1000] * 5, 1000 * LAPSE * 1.01)[-1]


def test_one_short_or_long_interval_is_no_pace() -> None:
    """A busy machine drops images; a hiccup before a gap hides none."""
    assert not any(lapses(*[400, 500, 100, 450, 950] * 4)[3:])
    assert lapses(33, 33, 33, 500, 1400)[-1]


def test_only_what_shows_something_counts_and_no_image_for_long() -> None:
    search = Search()
    search.begin(1000 * MS)
    for at, shows in ((1100, True), (1200, False), (1300, True), (9300, True)):
        search.look(at * MS, shows)
    assert search.lost
    assert search.at_ns == 9300 * MS
    assert search.looked_s == pytest.approx(0.2 + MOST_BETWEEN_NS * 1e-9)
    search.begin(9400 * MS)
    assert search.looked_s == 0.0
