"""Whole numbers in order, short and long ones."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from prism_edge.tracking.sorting import order_of


@pytest.mark.parametrize("below", [10, 1 << 16, (1 << 16) + 1, 1 << 40])
@settings(max_examples=50, deadline=None)
@given(data=st.data())
def test_smaller_ones_come_first_and_like_ones_as_they_came(below: int, data: st.DataObject) -> None:
    numbers = data.draw(st.lists(st.integers(0, below - 1) | st.integers(max(below - 3, 0), below - 1)))
    found = order_of(np.array(numbers, np.int64), below)
    assert found.tolist() == sorted(range(len(numbers)), key=lambda index: (numbers[index], index))
