"""The readout that was found of a map, in its file: kept, absent or refused."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from prism_edge.backend import map_file
from prism_edge.backend.local_copy import local_copy
from prism_edge.backend.map_readout import FIELD, readout_info, readout_told
from prism_edge.backend.map_scale import KnownScale
from prism_edge.backend.mapper import Mapper
from prism_edge.config import BackendConfig
from prism_edge.errors import MapError
from tests.backend.world import Teller
from tests.tracking.cloud import pose_at


@given(st.floats(-100.0, 100.0))
def test_what_is_written_is_read_to_the_last_digit(readout_ms: float) -> None:
    info, _ = map_file.unpack(map_file.pack(readout_info(readout_ms), {}))
    assert readout_told(info) == readout_ms


def test_maps_in_which_none_was_found_say_nothing() -> None:
    assert readout_info(0.0) == {}
    assert readout_told({}) == 0.0


@pytest.mark.parametrize("told", ["26", None, True, [26.0], 100.1, -101, float("nan"), 10**400])
def test_what_is_no_readout_is_refused(told: object) -> None:
    with pytest.raises(MapError, match=FIELD):
        readout_told({FIELD: told})


@pytest.mark.parametrize("in_use", [True, False])
def test_a_map_that_is_taken_up_knows_it(in_use: bool) -> None:
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
    made.restore({k: v for k, v in info.items() if k != FIELD}, arrays)
    assert made.world.readout_ms == 0.0
    assert np.array_equal(pixels, made.world.keyframes[1].pixels), "they are stored as they are now"


def test_each_update_says_it() -> None:
    made, teller = Mapper(BackendConfig()), Teller()
    for i in range(3):
        made.absorb(teller.keyframe(pose_at(0.2 * i)))
    made.world.readout_ms = 26.5
    window = made.optimise(2, 0.0)
    assert window is not None
    assert window.readout_ms == made.whole(2, made.loops.take_changes()).readout_ms == 26.5
