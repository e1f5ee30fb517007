"""Which part of a map each keyframe is of, in its file: exact, absent or refused."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from prism_edge.backend import map_file
from prism_edge.backend.connectivity import parts_of
from prism_edge.backend.map_parts import FIELD, MOST, parts_info, parts_told
from prism_edge.backend.map_stamps import LATEST_NS, stamps_info
from prism_edge.backend.map_stamps import MOST as MOST_STAMPS
from prism_edge.backend.stored_map import from_arrays, to_arrays
from prism_edge.errors import MapError
from prism_edge.messages import HOME, LARGEST_ID
from tests.backend.test_stored_map import EXAMPLE, STORED, example

NUMBERS = st.integers(0, LARGEST_ID - 1)


@given(st.dictionaries(NUMBERS, NUMBERS | st.just(HOME), max_size=9))
def test_what_is_written_is_read(parts: dict[int, int]) -> None:
    info, _ = map_file.unpack(map_file.pack(parts_info(parts), {}))
    away = {k: part for k, part in parts.items() if part != HOME}
    assert parts_told(info) == (None if away and away == parts else away)


def test_maps_of_earlier_builds_do_not_say_and_nobody_makes_it_up() -> None:
    assert parts_told({}) is None
    assert parts_info({0: HOME, 1: None, 2: 2}) == {}
    old = {name: value for name, value in STORED[0].items() if name != FIELD}
    world, index = from_arrays(old, STORED[1], max_carried=100)
    assert {keyframe.part for keyframe in world.keyframes.values()} == {None}
    assert FIELD not in to_arrays(world, index)[0]


def test_the_longest_that_there_can_be_fit_into_a_header_and_more_are_left_out() -> None:
    longest = parts_info({0: HOME} | {LARGEST_ID - 1 - i: LARGEST_ID - 1 for i in range(MOST)})
    assert len(longest[FIELD]) == MOST
    stamps = stamps_info([-LATEST_NS] * MOST_STAMPS)
    map_file.pack({**longest, **stamps, "model": "x" * 10_000}, {})
    assert parts_info(dict.fromkeys(range(MOST + 1), 5)) == {}
    assert parts_info(dict.fromkeys(range(MOST + 1), 5) | {MOST + 1: HOME}) == {}


@pytest.mark.parametrize(
    "told",
    [
        *(None, 5, "home", {}, [1], [[1]], [[1, 2, 3]]),
        *([[1, -1]], [[1, 2.0]], [[True, 1]], [[1, LARGEST_ID]], [["1", 2]]),
    ],
    ids=str,
)
def test_what_is_no_part_is_refused(told: object) -> None:
    with pytest.raises(MapError, match=FIELD):
        parts_told({FIELD: told})
    with pytest.raises(MapError, match=FIELD):
        from_arrays({**STORED[0], FIELD: told}, STORED[1], max_carried=100)


def test_what_was_made_at_home_is_at_home_in_the_map_that_is_taken_up() -> None:
    """Also where no point joins it to the rest any more."""
    world, index = example()
    numbers = sorted(world.keyframes)
    for k in numbers[2:5]:
        for point in list(world.keyframes[k].observed):
            world.drop_observation(k, point)
    world.keyframes[numbers[3]].part = 4
    again, _ = from_arrays(*map_file.unpack(map_file.pack(*to_arrays(world, index))), max_carried=100)
    assert {k: keyframe.part for k, keyframe in again.keyframes.items()} == {
        k: 4 if k == numbers[3] else HOME for k in numbers
    }
    assert parts_of(again) == {numbers[3]: 4}
    assert {keyframe.part for keyframe in EXAMPLE[0].keyframes.values()} == {HOME}


def test_a_map_of_which_nothing_is_at_home_is_its_own_home() -> None:
    """A backend that began anew while the camera was in a part of its own has heard of nothing else."""
    world, index = example()
    for keyframe in world.keyframes.values():
        keyframe.part = 5
    info, arrays = to_arrays(world, index)
    assert FIELD not in info
    told = [[k, 5] for k in world.keyframes]
    for known in (info, {**info, FIELD: told}):  # earlier builds wrote it
        again, _ = from_arrays(known, arrays, max_carried=100)
        assert parts_of(again) == {}
    again, _ = from_arrays({**info, FIELD: told[1:]}, arrays, max_carried=100)
    assert {keyframe.part for keyframe in again.keyframes.values()} == {HOME, 5}
