"""What unusable answers of a network become."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from prism_edge.depth.prediction import Prediction, checked, no_confidence, no_descriptor


def prediction(depth: np.ndarray, **more: np.ndarray) -> Prediction:
    parts = {"confidence": no_confidence(), "descriptor": no_descriptor(), **more}
    return Prediction(depth.astype(np.float32), np.array([1.0, 0.0, 1.0, 0.0]), inference_ms=1.0, **parts)


SLOPE = np.linspace(1.0, 4.0, 100).reshape(10, 10)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 0.0, -1.0])
def test_unusable_pixels_become_zero_and_the_rest_stays(bad):
    depth = SLOPE.copy()
    depth[:5] = bad
    out = checked(prediction(depth))
    assert out.valid
    assert np.all(out.depth[:5] == 0)
    assert np.array_equal(out.depth[5:], SLOPE[5:].astype(np.float32))


@pytest.mark.parametrize(
    ("depth", "says"),
    [
        (np.full((10, 10), np.nan), "NaN"),
        (np.full((10, 10), np.inf), "infinite"),
        (np.zeros((10, 10)), "zero"),
        (-SLOPE, "negative"),
        (np.full((10, 10), 2.5), "constant"),
        (np.where(np.arange(100).reshape(10, 10) < 15, SLOPE, np.nan), "15 %"),
        (np.zeros((0, 0)), "empty"),
    ],
)
def test_a_useless_map_is_marked_with_its_reason(depth, says):
    out = checked(prediction(depth))
    assert not out.valid
    assert says in out.reason
    assert out.depth.shape == depth.shape
    assert not out.depth.any()


def test_confidence_and_descriptor_never_carry_nan():
    spoilt = SLOPE.astype(np.float32).copy()
    spoilt[0, 0] = np.nan
    out = checked(prediction(SLOPE, confidence=spoilt, descriptor=np.array([1.0, np.inf], np.float32)))
    assert out.valid
    assert out.confidence[0, 0] == 0
    assert out.descriptor.size == 0


@settings(max_examples=60, deadline=None)
@given(hnp.arrays(np.float32, st.integers(0, 20), elements=st.floats(width=32)))
def test_a_descriptor_has_norm_one_or_is_none(values):
    with np.errstate(over="ignore"):
        out = checked(prediction(SLOPE, descriptor=values)).descriptor
    assert out.dtype == np.float32
    if out.size:
        assert np.linalg.norm(out.astype(np.float64)) == pytest.approx(1.0, abs=1e-6)
        assert out.astype(np.float64) @ values.astype(np.float64) > 0
    else:
        norm = np.linalg.norm(values.astype(np.float64))
        assert not norm >= 1e-6 or np.isinf(norm)


@settings(max_examples=60, deadline=None)
@given(hnp.arrays(np.float32, (6, 7), elements=st.floats(width=32)))
def test_whatever_comes_in_only_metres_come_out(depth):
    out = checked(prediction(depth))
    assert np.all(np.isfinite(out.depth))
    assert np.all(out.depth >= 0)
    assert out.valid == (out.reason == "")
    assert out.valid == bool(out.depth.any())
