"""What the backend's adjustments took, and what poses that came meanwhile had of it; pure."""

from __future__ import annotations

from typing import Any

import numpy as np

from prism_edge.evaluation.recording import Recording
from prism_edge.geometry.poses import Array


def cost_of_adjustments(recording: Recording) -> dict[str, Any]:
    """Under their names in metrics.json (docs/EVALUATION.md); None where there is nothing to tell.

    A pose came during a global adjustment if it arrived between its beginning and its end.
    """
    windows = np.array([s.ended_ns - s.began_ns for s in recording.solved if not s.everything]) / 1e6
    whole = [s for s in recording.solved if s.everything]
    arrivals, latencies = recording.arrivals_and_latencies()
    during = np.zeros(len(arrivals), bool)
    for solved in whole:
        during |= (arrivals >= solved.began_ns) & (arrivals <= solved.ended_ns)
    return {
        "windows": len(windows),
        "window_ms": {"p50": _percentile(windows, 50), "p95": _percentile(windows, 95)},
        "global": len(whole),
        "global_keyframes": max((s.keyframes for s in whole), default=None),
        "global_cpu_s": max((s.cpu_s for s in whole), default=None),
        "poses_during_global": int(during.sum()),
        "latency_p99_ms": {
            "during_global": _percentile(latencies[during], 99),
            "otherwise": _percentile(latencies[~during], 99),
        },
    }


def _percentile(values: Array, percent: float) -> float | None:
    return float(np.percentile(values, percent)) if len(values) else None
