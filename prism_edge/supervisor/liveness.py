"""Tells a process that works from one that hangs, from what it last said."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from prism_edge.messages import Heartbeat


ALIVE, QUIET, OVERDUE = "alive", "quiet", "overdue"

QUIET_S = 2.0  # heartbeats come twice a second; four missed ones are worth reporting
SILENT_S = 5.0  # without declared work, a process this long silent is stopped or gone


@dataclass(frozen=True)
class Verdict:
    """``alive``, ``quiet`` (reported) or ``overdue`` (killed and started again), and why."""

    liveness: str
    why: str = ""


def judge(heartbeat: Heartbeat | None, age_s: float, longer_s: float = 0.0) -> Verdict:
    """What to think of a process whose last heartbeat came ``age_s`` seconds ago (receiver's clock).

    Nothing is held against a process that was never heard. Native code that holds the interpreter's lock
    silences heartbeats too, so declared work is given its whole budget before silence counts. Only
    differences of the sender's clock are used: a process may run on another host. What belongs to a start may
    take ``longer_s`` beyond its budget.
    """
    if heartbeat is None:
        return Verdict(ALIVE)
    if heartbeat.state in ("starting", "working"):
        busy_s = (heartbeat.monotonic_ns - heartbeat.activity_since_ns) * 1e-9 + age_s
        budget_s = heartbeat.budget_s + (longer_s if heartbeat.state == "starting" else 0.0)
        if busy_s > budget_s:
            what = heartbeat.activity or heartbeat.state
            return Verdict(OVERDUE, f"{what} has taken {busy_s:.1f} s of {budget_s:.1f} s")
        return Verdict(ALIVE)
    if age_s > SILENT_S:
        return Verdict(OVERDUE, f"silent for {age_s:.1f} s")
    if age_s > QUIET_S:
        return Verdict(QUIET, f"silent for {age_s:.1f} s")
    return Verdict(ALIVE)
