"""When images were taken: what their numbers and stamps tell by themselves."""

from __future__ import annotations

import pytest

from prism_edge.tracking.pace import Pace

MS = 1_000_000


def paced(pace: Pace, steps: list[tuple[int, int]], index: int = 0, stamp_ms: int = 0) -> tuple[int, int]:
    """Images come, each so many numbers and milliseconds after the one before; where that leads to."""
    for images, took_ms in steps:
        index, stamp_ms = index + images, stamp_ms + took_ms
        pace.see(index, stamp_ms * MS)
    return index, stamp_ms


def test_images_that_were_passed_over_count_where_some_come_together() -> None:
    """A third of a 30 Hz camera's are tracked: three in 20 ms were not taken so, though one may have been."""
    pace = Pace()
    at = paced(pace, 12 * [(3, 100)])
    assert pace.step_s == 0.0, "as they were stamped"
    paced(pace, [(3, 20)], *at)
    assert pace.step_s == pytest.approx(0.1, rel=0.1)


def test_after_a_gap_the_pace_is_looked_for_anew() -> None:
    pace = Pace()
    at = paced(pace, 40 * [(1, 33)])
    assert pace.usual_s == pytest.approx(0.033, rel=0.01)
    at = paced(pace, [(1, 600)], *at)
    assert (pace.usual_s, pace.step_s, pace.longest_s) == (0.0, 0.0, 0.0)
    paced(pace, 10 * [(1, 33)], *at)
    assert pace.step_s == 0.0, "the gap is no step of this camera's"
    assert pace.usual_s == pytest.approx(0.033, rel=0.01)
