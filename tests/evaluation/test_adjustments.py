"""What adjusting costs, from a run that was written down by hand."""

from __future__ import annotations

import pytest

from prism_edge.evaluation.adjustments import cost_of_adjustments
from prism_edge.evaluation.recording import Recording
from prism_edge.evaluation.trajectory import NS
from prism_edge.messages import Solved
from tests.evaluation.test_recording import PERIOD, frame, pose


def solved(
    everything: bool, began_s: float, ended_s: float, cpu_s: float = 0.1, keyframes: int = 7
) -> Solved:
    return Solved(everything, keyframes, 10 * NS + int(began_s * NS), 10 * NS + int(ended_s * NS), cpu_s)


def test_windows_and_global_adjustments_are_told_apart() -> None:
    windows = [solved(False, 0.1 * i, 0.1 * i + 0.001 * i) for i in range(101)]
    whole = [solved(True, 1.0, 2.0, 0.3, 20), solved(True, 3.0, 4.0, 0.2, 30)]
    found = cost_of_adjustments(Recording(solved=[*windows, *whole]))
    assert found["windows"] == 101
    assert found["window_ms"] == {"p50": pytest.approx(50), "p95": pytest.approx(95)}
    assert (found["global"], found["global_keyframes"], found["global_cpu_s"]) == (2, 30, 0.3)


def test_poses_count_for_the_adjustment_that_they_arrived_in() -> None:
    during = set(range(30, 61))  # arrive between 1 s and 2 s
    poses = [pose(i, late_ms=25.0 if i in during else 10.0) for i in range(90)]
    last_ns = poses[60].arrival_ns - 10 * NS
    recording = Recording(
        poses,
        [frame(i) for i in range(90)],
        solved=[solved(True, 30 * PERIOD / NS + 0.011, last_ns / NS + 1e-6), solved(False, 0.0, 3.0)],
    )
    found = cost_of_adjustments(recording)
    assert found["poses_during_global"] == 31
    assert found["latency_p99_ms"] == {"during_global": pytest.approx(25), "otherwise": pytest.approx(10)}


def test_a_run_without_a_backend_has_nothing_to_tell() -> None:
    found = cost_of_adjustments(Recording())
    assert (found["windows"], found["global"], found["poses_during_global"]) == (0, 0, 0)
    assert found["window_ms"] == {"p50": None, "p95": None}
    assert found["latency_p99_ms"] == {"during_global": None, "otherwise": None}
    assert found["global_cpu_s"] is None
