"""A process on another host: watched by what it says, and started by whoever is there."""

from __future__ import annotations

from typing import TYPE_CHECKING

from prism_edge.supervisor.health import ERROR, OK, WARN, Row
from prism_edge.supervisor.liveness import ALIVE, judge

if TYPE_CHECKING:
    from prism_edge.messages import Heartbeat


class RemoteWatch:
    """What is known of it. Poses flow without it, so it holds up neither readiness nor the watchdog."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._heartbeat: Heartbeat | None = None
        self._heard_s = 0.0

    def heard(self, heartbeat: Heartbeat, now_s: float) -> None:
        """A heartbeat has come."""
        self._heartbeat, self._heard_s = heartbeat, now_s

    def row(self, now_s: float) -> Row:
        """Its line on `health`."""
        if self._heartbeat is None:
            return Row(self._name, ERROR, "not heard from its host", {"state": "remote"})
        verdict = judge(self._heartbeat, now_s - self._heard_s)
        beat = self._heartbeat
        values = {"state": beat.state, "activity": beat.activity, **beat.values}
        if verdict.liveness != ALIVE:
            return Row(self._name, ERROR, verdict.why, values)
        if "warning" in values:
            return Row(self._name, WARN, values["warning"], values)
        return Row(self._name, OK, self._heartbeat.state, values)
