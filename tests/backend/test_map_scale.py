"""What a stored map says of its unit, and what of that can't be."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from prism_edge.backend.map_scale import LARGEST_LOG_SCALE, KnownScale
from prism_edge.errors import MapError

TOLD = {"log_scale": 0.5, "scale_sigma": 0.1, "bias_sigma": 0.07, "lost_sigma": 2.0, "scale_by": "net@1"}
sigmas = st.floats(0.0, LARGEST_LOG_SCALE, exclude_max=True)
log_scales = st.floats(-LARGEST_LOG_SCALE, LARGEST_LOG_SCALE, exclude_max=True)


@given(st.builds(KnownScale, log_scales, sigmas, sigmas, st.text(), sigmas))
def test_what_is_told_is_read(scale: KnownScale) -> None:
    assert KnownScale.of(scale.info) == scale


def test_of_which_nothing_is_known_a_unit_counts_as_a_metre_give_or_take() -> None:
    """It goes into the file and comes back as what it is: nobody's measurement."""
    unknown = KnownScale()
    assert unknown.info["log_scale"] == 0.0
    assert not KnownScale.of(unknown.info).is_known
    assert KnownScale(0.0, 0.1).is_known
    assert KnownScale(network="net@1").is_known


def test_maps_of_earlier_builds_know_of_no_bias_and_no_network() -> None:
    assert KnownScale.of({"log_scale": 0, "scale_sigma": 0.1}) == KnownScale(0.0, 0.1)


def test_all_that_is_told_apart_is_in_the_whole() -> None:
    assert KnownScale(0.0, 0.3, 0.4, lost_sigma=1.2).whole_sigma == pytest.approx(1.3)


@pytest.mark.parametrize("name", ["log_scale", "scale_sigma", "bias_sigma", "lost_sigma"])
@pytest.mark.parametrize("value", [True, "1", None, [1.0], math.nan, math.inf, -math.inf, LARGEST_LOG_SCALE])
def test_what_is_no_number_of_that_kind_is_refused(name: str, value: object) -> None:
    with pytest.raises(MapError, match=f"^the map's {name} is none$"):
        KnownScale.of({**TOLD, name: value})


@pytest.mark.parametrize("name", ["scale_sigma", "bias_sigma", "lost_sigma"])
def test_no_sigma_is_below_zero(name: str) -> None:
    with pytest.raises(MapError, match=name):
        KnownScale.of({**TOLD, name: -0.1})


@pytest.mark.parametrize("value", [None, 1, {"a": 1}])
def test_a_network_is_known_by_a_name(value: object) -> None:
    with pytest.raises(MapError, match="no network"):
        KnownScale.of({**TOLD, "scale_by": value})
