"""What a map's file says beside its arrays: exact, absent or refused."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from prism_edge.backend import map_file
from prism_edge.backend.connectivity import parts_of
from prism_edge.backend.global_map import LONG_AGO
from prism_edge.backend.local_copy import local_copy
from prism_edge.backend.map_facts import (
    LATEST_NS,
    MOST_AWAY,
    MOST_STAMPS,
    MOST_STAND_INS,
    PARTS,
    READOUT,
    STAMPS,
    STAND_INS,
    parts_info,
    parts_told,
    readout_info,
    readout_told,
    stamps_info,
    stamps_told,
    stand_ins_info,
    stand_ins_told,
)
from prism_edge.backend.map_scale import KnownScale
from prism_edge.backend.mapper import Mapper
from prism_edge.backend.stored_map import from_arrays, to_arrays
from prism_edge.config import BackendConfig
from prism_edge.errors import MapError
from prism_edge.messages import HOME, LARGEST_ID
from tests.backend.test_stored_map import EXAMPLE, STORED, example
from tests.backend.world import Teller
from tests.tracking.cloud import pose_at

NUMBERS = st.integers(0, LARGEST_ID - 1)



@given(st.lists(st.none() | st.integers(-LATEST_NS, LATEST_NS), max_size=9))
def test_stamps_are_read_to_the_last_digit(stamps: list[int | None]) -> None:
    info, _ = map_file.unpack(map_file.pack(stamps_info(stamps), {}))
    assert stamps_told(info, len(stamps)) == stamps
    assert (STAMPS in info) == any(stamp is not None for stamp in stamps)


def test_maps_of_earlier_builds_do_not_say_when_they_were_made() -> None:
    assert stamps_told({}, 3) == [None] * 3


def test_the_longest_stamps_fit_into_a_header_and_more_are_left_out() -> None:
    longest = stamps_info([-LATEST_NS] * MOST_STAMPS)
    assert len(longest[STAMPS]) == MOST_STAMPS
    map_file.pack({**longest, "model": "x" * 10_000}, {})
    assert stamps_info([-LATEST_NS] * (MOST_STAMPS + 1)) == {}


@pytest.mark.parametrize(
    "told",
    [None, 5, "now", {}, [], [1, 2], [1, 2, 3, 4], [1, 2, 3.0], [1, 2, True], [1, 2, "3"], [1, 2, 2**63]],
    ids=str,
)
def test_what_is_no_time_of_each_keyframe_is_refused(told: object) -> None:
    with pytest.raises(MapError, match=STAMPS):
        stamps_told({STAMPS: told}, 3)
    with pytest.raises(MapError, match=STAMPS):
        from_arrays({**STORED[0], STAMPS: told}, STORED[1], max_carried=100)


def test_a_map_that_is_taken_up_and_saved_again_keeps_its_stamps() -> None:
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


def test_a_map_of_an_earlier_build_that_goes_on_says_which_stamps_are_known() -> None:
    old = {name: value for name, value in STORED[0].items() if name != STAMPS}
    world, index = from_arrays(old, STORED[1], max_carried=100)
    assert STAMPS not in to_arrays(world, index)[0]
    world.keyframes[7].taken_ns = 5
    assert to_arrays(world, index)[0][STAMPS] == [None] * 6 + [5]



@given(st.sets(st.integers(0, LARGEST_ID - 1), max_size=9))
def test_stand_ins_are_read_as_written(numbers: set[int]) -> None:
    info, _ = map_file.unpack(map_file.pack(stand_ins_info(list(numbers)), {}))
    assert stand_ins_told(info) == numbers


def test_of_too_many_stand_ins_the_newest_are_written() -> None:
    assert stand_ins_told(stand_ins_info(range(MOST_STAND_INS + 5))) == set(range(5, MOST_STAND_INS + 5))


def test_a_map_that_is_taken_up_again_has_its_stand_ins_still() -> None:
    world, index = from_arrays(*STORED, max_carried=100)
    assert not any(keyframe.stands_in for keyframe in world.keyframes.values())
    assert STAND_INS not in to_arrays(world, index)[0]  # as an earlier build would have it
    newest = max(world.keyframes)
    world.keyframes[newest].stands_in = True
    again, _ = from_arrays(*to_arrays(world, index), max_carried=100)
    assert [k for k, keyframe in again.keyframes.items() if keyframe.stands_in] == [newest]


def test_the_longest_stand_ins_fit_into_a_header_beside_all_else() -> None:
    away = {LARGEST_ID - 1 - i: LARGEST_ID - 1 for i in range(MOST_AWAY)}
    parts = parts_info({0: HOME} | away)
    stamps = stamps_info([-LATEST_NS] * MOST_STAMPS)
    longest = stand_ins_info(range(LARGEST_ID - 2 * MOST_STAND_INS, LARGEST_ID))
    map_file.pack({**longest, **parts, **stamps, "model": "x" * 10_000}, {})


@pytest.mark.parametrize(
    "told",
    [None, 5, "all", {}, [-1], [2.0], [True], [LARGEST_ID], ["1"], [[1]], [1] * (MOST_STAND_INS + 1)],
    ids=str,
)
def test_what_is_no_keyframe_is_refused(told: object) -> None:
    with pytest.raises(MapError, match=STAND_INS):
        stand_ins_told({STAND_INS: told})
    with pytest.raises(MapError, match=STAND_INS):
        from_arrays({**STORED[0], STAND_INS: told}, STORED[1], max_carried=100)



@given(st.dictionaries(NUMBERS, NUMBERS | st.just(HOME), max_size=9))
def test_parts_are_read_as_written(parts: dict[int, int]) -> None:
    info, _ = map_file.unpack(map_file.pack(parts_info(parts), {}))
    away = {k: part for k, part in parts.items() if part != HOME}
    assert parts_told(info) == (None if away and away == parts else away)


def test_maps_of_earlier_builds_do_not_say_their_parts_and_nobody_makes_them_up() -> None:
    assert parts_told({}) is None
    assert parts_info({0: HOME, 1: None, 2: 2}) == {}
    old = {name: value for name, value in STORED[0].items() if name != PARTS}
    world, index = from_arrays(old, STORED[1], max_carried=100)
    assert {keyframe.part for keyframe in world.keyframes.values()} == {None}
    assert PARTS not in to_arrays(world, index)[0]


def test_the_longest_parts_fit_into_a_header_and_more_are_left_out() -> None:
    longest = parts_info({0: HOME} | {LARGEST_ID - 1 - i: LARGEST_ID - 1 for i in range(MOST_AWAY)})
    assert len(longest[PARTS]) == MOST_AWAY
    stamps = stamps_info([-LATEST_NS] * MOST_STAMPS)
    map_file.pack({**longest, **stamps, "model": "x" * 10_000}, {})
    assert parts_info(dict.fromkeys(range(MOST_AWAY + 1), 5)) == {}
    assert parts_info(dict.fromkeys(range(MOST_AWAY + 1), 5) | {MOST_AWAY + 1: HOME}) == {}


@pytest.mark.parametrize(
    "told",
    [
        *(None, 5, "home", {}, [1], [[1]], [[1, 2, 3]]),
        *([[1, -1]], [[1, 2.0]], [[True, 1]], [[1, LARGEST_ID]], [["1", 2]]),
    ],
    ids=str,
)
def test_what_is_no_part_is_refused(told: object) -> None:
    with pytest.raises(MapError, match=PARTS):
        parts_told({PARTS: told})
    with pytest.raises(MapError, match=PARTS):
        from_arrays({**STORED[0], PARTS: told}, STORED[1], max_carried=100)


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
    assert PARTS not in info
    told = [[k, 5] for k in world.keyframes]
    for known in (info, {**info, PARTS: told}):  # earlier builds wrote it
        again, _ = from_arrays(known, arrays, max_carried=100)
        assert parts_of(again) == {}
    again, _ = from_arrays({**info, PARTS: told[1:]}, arrays, max_carried=100)
    assert {keyframe.part for keyframe in again.keyframes.values()} == {HOME, 5}



@given(st.floats(-100.0, 100.0))
def test_a_readout_is_read_to_the_last_digit(readout_ms: float) -> None:
    info, _ = map_file.unpack(map_file.pack(readout_info(readout_ms), {}))
    assert readout_told(info) == readout_ms


def test_maps_in_which_no_readout_was_found_say_nothing() -> None:
    assert readout_info(0.0) == {}
    assert readout_told({}) == 0.0


@pytest.mark.parametrize("told", ["26", None, True, [26.0], 100.1, -101, float("nan"), 10**400])
def test_what_is_no_readout_is_refused(told: object) -> None:
    with pytest.raises(MapError, match=READOUT):
        readout_told({READOUT: told})


@pytest.mark.parametrize("in_use", [True, False])
def test_a_map_that_is_taken_up_knows_its_readout(in_use: bool) -> None:
    made, teller, again = Mapper(BackendConfig()), Teller(), Mapper(BackendConfig())
    for i in range(3):
        made.absorb(teller.keyframe(pose_at(0.2 * i)))
    made.world.readout_ms = 26.5
    stored, arrays = made.stored(in_use)
    info, arrays = map_file.unpack(map_file.pack({**stored, **KnownScale().info}, arrays))
    again.restore(info, arrays)
    assert again.world.readout_ms == local_copy(again.world).readout_ms == 26.5
    assert again.whole(2, again.loops.take_changes()).readout_ms == 26.5
    pixels = again.world.keyframes[1].pixels.copy()
    made.restore({k: v for k, v in info.items() if k != READOUT}, arrays)
    assert made.world.readout_ms == 0.0
    assert np.array_equal(pixels, made.world.keyframes[1].pixels), "they are stored as they are now"


def test_each_update_says_the_readout() -> None:
    made, teller = Mapper(BackendConfig()), Teller()
    for i in range(3):
        made.absorb(teller.keyframe(pose_at(0.2 * i)))
    made.world.readout_ms = 26.5
    window = made.optimise(2, 0.0)
    assert window is not None
    assert window.readout_ms == made.whole(2, made.loops.take_changes()).readout_ms == 26.5
