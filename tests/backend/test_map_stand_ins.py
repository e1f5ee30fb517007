"""Which keyframes of a map stand in for older ones, in its file: exact, absent or refused."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from prism_edge.backend import map_file, map_parts, map_stamps
from prism_edge.backend.map_stand_ins import FIELD, MOST, stand_ins_info, stand_ins_told
from prism_edge.backend.stored_map import from_arrays, to_arrays
from prism_edge.errors import MapError
from prism_edge.messages import HOME, LARGEST_ID
from tests.backend.test_stored_map import STORED


@given(st.sets(st.integers(0, LARGEST_ID - 1), max_size=9))
def test_what_is_written_is_read(numbers: set[int]) -> None:
    info, _ = map_file.unpack(map_file.pack(stand_ins_info(list(numbers)), {}))
    assert stand_ins_told(info) == numbers


def test_of_too_many_the_newest_are_written() -> None:
    assert stand_ins_told(stand_ins_info(range(MOST + 5))) == set(range(5, MOST + 5))


def test_a_map_that_is_taken_up_again_has_them_still() -> None:
    world, index = from_arrays(*STORED, max_carried=100)
    assert not any(keyframe.stands_in for keyframe in world.keyframes.values())
    assert FIELD not in to_arrays(world, index)[0]  # as an earlier build would have it
    newest = max(world.keyframes)
    world.keyframes[newest].stands_in = True
    again, _ = from_arrays(*to_arrays(world, index), max_carried=100)
    assert [k for k, keyframe in again.keyframes.items() if keyframe.stands_in] == [newest]


def test_the_longest_that_there_can_be_fits_into_a_header_beside_all_else() -> None:
    away = {LARGEST_ID - 1 - i: LARGEST_ID - 1 for i in range(map_parts.MOST)}
    parts = map_parts.parts_info({0: HOME} | away)
    stamps = map_stamps.stamps_info([-map_stamps.LATEST_NS] * map_stamps.MOST)
    longest = stand_ins_info(range(LARGEST_ID - 2 * MOST, LARGEST_ID))
    map_file.pack({**longest, **parts, **stamps, "model": "x" * 10_000}, {})


@pytest.mark.parametrize(
    "told", [None, 5, "all", {}, [-1], [2.0], [True], [LARGEST_ID], ["1"], [[1]], [1] * (MOST + 1)], ids=str
)
def test_what_is_no_keyframe_is_refused(told: object) -> None:
    with pytest.raises(MapError, match=FIELD):
        stand_ins_told({FIELD: told})
    with pytest.raises(MapError, match=FIELD):
        from_arrays({**STORED[0], FIELD: told}, STORED[1], max_carried=100)
