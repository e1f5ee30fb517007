"""What the tracker could not go on in."""

from __future__ import annotations

import numpy as np
import pytest

from prism_edge.backend.map_file import Arrays
from prism_edge.config import TrackingConfig
from prism_edge.workers.map_flaw import map_flaw, pyramid_flaw

OURS = TrackingConfig(levels=4, scale_factor=1.3)
SOUND: Arrays = {
    "keyframes": np.array([0, 7], np.int64),
    "seen": np.array([-1, 3], np.int64),
    "scale_factors": np.array([1.3, 1.3]),
    "octaves": np.array([0, 3], np.uint8),
}


@pytest.mark.parametrize(
    ("name", "values", "said"),
    [
        ("keyframes", SOUND["keyframes"], ""),
        ("keyframes", SOUND["keyframes"][:1], "keyframes"),
        ("seen", np.array([-1, -1], np.int64), "points"),
        ("seen", np.array([-1, 0], np.int64), ""),  # the first point is one, too
        ("scale_factors", np.array([1.3, 1.2]), "tracking.scale_factor than 1.3"),
        ("octaves", np.array([4, 0], np.uint8), "tracking.levels than 4"),
        ("octaves", np.zeros(0, np.uint8), ""),
    ],
)
def test_what_is_wrong_is_said(name: str, values: np.ndarray, said: str) -> None:
    flaw = map_flaw({**SOUND, name: values}, OURS)
    assert said in flaw
    assert bool(flaw) == bool(said)


def test_columns_that_are_missing_or_odd_are_not_its_business() -> None:
    assert pyramid_flaw({}, OURS) == ""
    assert map_flaw({}, OURS)
    assert map_flaw({**SOUND, "keyframes": np.array(3)}, OURS)
    assert pyramid_flaw({"octaves": np.array([[np.nan]]), "scale_factors": np.full((2, 2), 1.3)}, OURS) == ""
