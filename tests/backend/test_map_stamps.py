"""When keyframes were taken, in a map's file: exact, absent or refused."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from prism_edge.backend import map_file
from prism_edge.backend.global_map import LONG_AGO
from prism_edge.backend.map_stamps import FIELD, LATEST_NS, MOST, stamps_info, stamps_of
from prism_edge.backend.stored_map import from_arrays, to_arrays
from prism_edge.errors import MapError
from tests.backend.test_stored_map import EXAMPLE, STORED


@given(st.lists(st.none() | st.integers(-LATEST_NS, LATEST_NS), max_size=9))
def test_what_is_written_is_read_to_the_last_digit(stamps: list[int | None]) -> None:
    info, _ = map_file.unpack(map_file.pack(stamps_info(stamps), {}))
    assert stamps_of(info, len(stamps)) == stamps
    assert (FIELD in info) == any(stamp is not None for stamp in stamps)


def test_maps_of_earlier_builds_do_not_say() -> None:
    assert stamps_of({}, 3) == [None] * 3


def test_the_longest_that_there_can_be_fit_into_a_header_and_more_are_left_out() -> None:
    longest = stamps_info([-LATEST_NS] * MOST)
    assert len(longest[FIELD]) == MOST
    map_file.pack({**longest, "model": "x" * 10_000}, {})
    assert stamps_info([-LATEST_NS] * (MOST + 1)) == {}


@pytest.mark.parametrize(
    "told",
    [None, 5, "now", {}, [], [1, 2], [1, 2, 3, 4], [1, 2, 3.0], [1, 2, True], [1, 2, "3"], [1, 2, 2**63]],
    ids=str,
)
def test_what_is_no_time_of_each_keyframe_is_refused(told: object) -> None:
    with pytest.raises(MapError, match=FIELD):
        stamps_of({FIELD: told}, 3)
    with pytest.raises(MapError, match=FIELD):
        from_arrays({**STORED[0], FIELD: told}, STORED[1], max_carried=100)


def test_a_map_that_is_taken_up_and_saved_again_keeps_them() -> None:
    world, _ = EXAMPLE
    expected = {k: 300_000_000 * k for k in (0, 1, 2, 4, 5, 6, 7)}
    assert {k: keyframe.taken_ns for k, keyframe in world.keyframes.items()} == expected
    info, arrays = STORED
    for _ in range(2):
        again, index = from_arrays(info, arrays, max_carried=100)
        assert {k: keyframe.taken_ns for k, keyframe in again.keyframes.items()} == expected
        # Another run's clock says nothing of how long ago it was: a loop goes by this one.
        assert {keyframe.stamp_ns for keyframe in again.keyframes.values()} == {LONG_AGO}
        info, arrays = to_arrays(again, index)


def test_a_map_of_an_earlier_build_that_goes_on_says_what_is_known() -> None:
    old = {name: value for name, value in STORED[0].items() if name != FIELD}
    world, index = from_arrays(old, STORED[1], max_carried=100)
    assert FIELD not in to_arrays(world, index)[0]
    world.keyframes[7].taken_ns = 5
    assert to_arrays(world, index)[0][FIELD] == [None] * 6 + [5]
