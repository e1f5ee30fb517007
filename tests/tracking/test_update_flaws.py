"""Which corrections can't be taken over: their arrays don't go together, or hold no numbers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from prism_edge.messages import MapUpdate
from prism_edge.tracking.map_correction import flaw
from tests.synthetic.messages import map_update


def sound() -> MapUpdate:
    """One that says two of everything."""
    two, floats = np.arange(2), np.ones(2, np.float32)
    return map_update(
        5, keyframes=two, poses=np.tile(np.eye(4), (2, 1, 1)), points=two, positions=np.ones((2, 3)),
        parallax_deg=floats, weights=floats, dropped_keyframes=two, dropped_points=two, fused_from=two,
        fused_into=two + 2, added_keyframes=two, added_points=two, added_keypoints=two,
        loop_units=np.array([0.1, 0.02]),
    )  # fmt: skip


ARRAYS = (
    "keyframes", "poses", "points", "positions", "parallax_deg", "weights", "dropped_keyframes",
    "dropped_points", "fused_from", "fused_into", "added_keyframes", "added_points", "added_keypoints",
    "loop_units",
)  # fmt: skip


@pytest.mark.parametrize("name", ARRAYS)
def test_an_array_that_lacks_one_is_a_flaw(name: str) -> None:
    update = sound()
    assert flaw(update) == ""
    assert flaw(replace(update, **{name: getattr(update, name)[:1]}))


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("name", ["poses", "positions", "parallax_deg", "weights", "loop_units"])
def test_what_is_no_number_is_a_flaw(name: str, value: float) -> None:
    update = sound()
    array = getattr(update, name).copy()
    array.flat[-1] = value
    assert name in flaw(replace(update, **{name: array}))


def test_without_weights_or_a_loop_s_units_nothing_is_amiss() -> None:
    update = sound()
    assert flaw(replace(update, weights=update.weights[:0], loop_units=update.loop_units[:0])) == ""
