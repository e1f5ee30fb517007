"""A process on another host: watched by what it says, and started by whoever is there."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

from prism_edge.supervisor.health import ERROR, OK, WARN, Row
from prism_edge.supervisor.liveness import OVERDUE, Verdict, judge

if TYPE_CHECKING:
    from prism_edge.messages import Heartbeat

log = logging.getLogger("prism_edge.supervisor")

FIRST_S = 10.0  # as long as it may take to be heard for the first time before the log says that it isn't
# Nobody kills it for its silence, so that is said in the midst of its work, too: it is most often the link.
UNHEARD_S = 10.0
REFUSED_S = 10.0  # after it has refused a message for the last time, that is said


class RemoteWatch:
    """What is known of it. Poses flow without it, so it holds up neither readiness nor the watchdog."""

    def __init__(self, name: str, since_s: float, own: dict[str, str] | None = None) -> None:
        """``since_s`` is when it began to be listened for, on the clock of all other times here.

        ``own`` is what its configuration must say as ours does, by the values that it is shown by.
        """
        self._name, self._since_s, self._own = name, since_s, own or {}
        self._heartbeat: Heartbeat | None = None
        self._heard_s = 0.0
        self._told: bool | None = None  # that it lives, or not; None: nothing yet
        self._told_differs = ""
        self._refused, self._refused_s = "0", float("-inf")  # messages so far, and when that grew

    def heard(self, heartbeat: Heartbeat, now_s: float) -> None:
        """A heartbeat has come."""
        self._heartbeat, self._heard_s = heartbeat, now_s
        refused = heartbeat.values.get("malformed", "0")
        if refused not in ("0", self._refused):
            self._refused_s = now_s
        self._refused = refused

    def tell(self, now_s: float) -> None:
        """Log that it has come, or gone: called all the time, once for each."""
        beat = self._heartbeat
        lives = beat is not None and self._judged(beat, now_s).liveness != OVERDUE
        differs = self._differs(beat) if beat is not None else ""
        if lives and differs != self._told_differs:  # started again meanwhile, maybe
            self._told_differs = differs
            if differs:
                log.error("%s, on another host: %s", self._name, differs)
        if lives is self._told or (beat is None and now_s - self._since_s < FIRST_S):
            return
        self._told = lives
        if lives:
            log.info("%s is heard from its host", self._name)
        else:
            log.warning("%s, on another host: %s", self._name, self.row(now_s).message)

    def row(self, now_s: float) -> Row:
        """Its line on `health`."""
        if self._heartbeat is None:
            return Row(self._name, ERROR, "not heard from its host", {"state": "remote"})
        beat = self._heartbeat
        verdict = self._judged(beat, now_s)
        values = {"state": beat.state, "activity": beat.activity, **beat.values}
        if verdict.liveness == OVERDUE:
            return Row(self._name, ERROR, verdict.why, values)
        if differs := self._differs(beat):
            return Row(self._name, ERROR, differs, values)
        if "warning" in values:
            return Row(self._name, WARN, values["warning"], values)
        if now_s - self._refused_s < REFUSED_S:
            said = f"refuses messages ({self._refused} so far): its log says why"
            return Row(self._name, WARN, said, values)
        return Row(self._name, OK, beat.state, values)

    def _differs(self, beat: Heartbeat) -> str:
        theirs = {key: beat.values.get(key, ours) for key, ours in self._own.items()}
        differ = [key for key, ours in self._own.items() if theirs[key] != ours]
        said = [f"{key} is {theirs[key]} (here {self._own[key]})" for key in differ]
        return f"in its configuration {', '.join(said)}: set both alike" if said else ""

    def _judged(self, beat: Heartbeat, now_s: float) -> Verdict:
        age_s = now_s - self._heard_s
        # Nor is a slow link's pause an end: what judges a silence here is how long it is, and nothing else.
        return Verdict(OVERDUE, f"silent for {age_s:.1f} s") if age_s > UNHEARD_S else judge(beat, 0.0)
