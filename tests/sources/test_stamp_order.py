"""Which stamps are out of line with the others."""

from __future__ import annotations

from itertools import combinations, pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from prism_edge.sources.stamps import out_of_line

S = 10**9
HOUR = 3600 * S
REGULAR = [1305031102 * S + k * S // 30 for k in range(90)]


def go_out(stamps: list[int]) -> int:
    """How many are released where each must lie behind all before it."""
    newest, count = -1, 0
    for stamp in stamps:
        if stamp > newest:
            newest, count = stamp, count + 1
    return count


def test_regular_stamps_are_in_line_whatever_pauses() -> None:
    assert out_of_line(REGULAR) == frozenset()
    assert out_of_line([*REGULAR[:45], *(stamp + 2 * HOUR for stamp in REGULAR[45:])]) == frozenset()


@pytest.mark.parametrize("place", [0, 1, 44, 88, 89])
def test_one_that_leaps_ahead_costs_itself_alone(place: int) -> None:
    stamps = list(REGULAR)
    stamps[place] += HOUR + S
    assert out_of_line(stamps) == {place}


@pytest.mark.parametrize("place", [0, 1, 44, 89])
def test_a_zero_costs_itself_alone(place: int) -> None:
    """In the middle it goes back, which is refused as ever."""
    stamps = list(REGULAR)
    stamps[place] = 0
    kept = [stamp for index, stamp in enumerate(stamps) if index not in out_of_line(stamps)]
    assert go_out(kept) == 89
    assert (out_of_line(stamps) == {0}) == (place == 0)


@pytest.mark.parametrize("wrong", [[0, 0], [0, S // 30, S // 15], [0, 0, 5, 3]])
def test_a_clock_that_begins_late_costs_what_came_before(wrong: list[int]) -> None:
    stamps = [*wrong, *REGULAR]
    kept = [stamp for index, stamp in enumerate(stamps) if index not in out_of_line(stamps)]
    assert kept == REGULAR


@pytest.mark.parametrize("late", [[0], [1, 0], [0, 1, 2], [0, 0]])
def test_what_comes_hours_behind_all_else_is_left_out(late: list[int]) -> None:
    stamps = [*REGULAR, *(REGULAR[-1] + 2 * HOUR + stamp for stamp in late)]
    assert out_of_line(stamps) == set(range(90, 90 + len(late)))


def test_a_clock_that_was_set_back_costs_the_shorter_part() -> None:
    stamps = [*REGULAR[:30], *(stamp - 60 * S for stamp in REGULAR[30:])]
    assert out_of_line(stamps) == set(range(30))


def test_what_no_message_can_hold_is_another_matter() -> None:
    assert out_of_line([5, 2**31 * S, 6, 7]) == frozenset()


def test_few_stamps_are_all_in_line() -> None:
    assert out_of_line([]) == frozenset()
    assert out_of_line([3]) == frozenset()
    assert out_of_line([0, 5 * HOUR]) == frozenset()


@settings(max_examples=200, deadline=None)
@given(st.lists(st.integers(0, 9), max_size=8))
def test_as_many_go_out_as_can_and_nothing_is_left_out_for_nothing(stamps: list[int]) -> None:
    left_out = out_of_line(stamps)
    kept = [stamp for index, stamp in enumerate(stamps) if index not in left_out]
    rows = (row for n in range(len(stamps), -1, -1) for row in combinations(stamps, n))
    most = next(len(row) for row in rows if all(b > a for a, b in pairwise(row)))
    assert go_out(kept) == most
    assert not left_out or go_out(stamps) < most
