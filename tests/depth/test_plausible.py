"""Which depths are doubted as metres."""

from __future__ import annotations

import numpy as np
import pytest

from prism_edge.depth.plausible import Range, range_of


def test_a_range_is_of_the_pixels_that_have_depth():
    depth = np.array([[0.0, 0.5, 1.0], [2.0, 4.0, 0.0]], np.float32)
    assert range_of(depth) == Range(0.5, 1.5, 4.0)
    assert str(range_of(depth)) == "0.5 to 4 m, median 1.5 m"
    assert str(Range(0.01234, 1331.4, 25000.0)) == "0.0123 to 25000 m, median 1331 m"
    assert range_of(np.zeros((2, 2), np.float32)) is None
    assert range_of(np.zeros((0, 0), np.float32)) is None


@pytest.mark.parametrize(
    ("median", "is_doubted"), [(0.01, True), (0.05, False), (2.0, False), (300.0, False), (1500.0, True)]
)
def test_metres_that_no_camera_sees_are_doubted(median: float, is_doubted: bool):
    doubt = Range(median, median, median).doubt
    assert ("depth_scale" in doubt) == is_doubted
    assert bool(doubt) == is_doubted
