"""What unusable answers of a network become."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from prism_edge.depth.prediction import (
    OPEN,
    PROBABILITY,
    Prediction,
    checked,
    in_its_range,
    no_confidence,
    no_descriptor,
)
from prism_edge.scale.gate import spatial_uncertainty


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


def test_what_is_infinitely_sure_is_no_less_sure_than_the_rest():
    sure = np.full((10, 10), 3.0, np.float32)
    sure[0, 0], sure[0, 1] = np.inf, -np.inf
    out = checked(prediction(SLOPE, confidence=sure)).confidence
    assert out[0, 0] == np.finfo(np.float32).max
    assert out[0, 1] == 0


@pytest.mark.parametrize(
    ("kind", "given", "uncertainty"),
    [
        (PROBABILITY, [-0.1, 0.0, 0.25, 1.2, np.inf], [1.0, 1.0, 0.75, 0.0, 0.0]),
        (OPEN, [-0.1, 0.0, 0.25, 1.0, 1.0], [np.nan, np.nan, 1.0, 1.0, 1.0]),  # no idea anywhere
        (OPEN, [0.5, 0.5, 0.5, 2.0, np.inf], [1.0, 1.0, 1.0, 0.5, 0.0]),
    ],
)
def test_confidence_of_a_kind_that_is_said_is_not_guessed_from_its_values(kind, given, uncertainty):
    held = in_its_range(np.array([given] * 5, np.float32), kind)
    depth = SLOPE[:5, :5]
    u = spatial_uncertainty(checked(prediction(depth, confidence=held)).confidence)
    np.testing.assert_allclose(u[0], uncertainty, atol=1e-6)


def test_of_no_kind_confidence_stays_as_it_is():
    given = np.array([[-0.1, 0.0, 0.25, 1.2, np.inf]], np.float32)
    np.testing.assert_array_equal(in_its_range(given, ""), given)


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
