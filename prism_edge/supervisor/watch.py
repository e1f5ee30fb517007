"""What the supervisor knows of one process and decides about it; no I/O, times are given."""

from __future__ import annotations

from typing import TYPE_CHECKING

from prism_edge.config import SupervisorConfig
from prism_edge.errors import BusError, ConfigError, ModelError, PrismError, SourceError, SupervisionError
from prism_edge.processes import Process
from prism_edge.supervisor.child import describe_exit
from prism_edge.supervisor.health import ERROR, OK, STALE, WARN, Row
from prism_edge.supervisor.liveness import ALIVE, OVERDUE, QUIET, Verdict, judge
from prism_edge.supervisor.restart import RestartPolicy

if TYPE_CHECKING:
    from prism_edge.messages import Heartbeat

USUAL_START_S = SupervisorConfig.start_s  # what budgets of work before `ready` are meant for
HUNG_STARTS = 3  # in a row; a process that hangs in more of them is not about to come back
USER_ERRORS = tuple(error.exit_code for error in (ConfigError, SourceError, ModelError, BusError))


class StartRefusedError(PrismError):
    """A worker ended with a user's error before it was ever ready; it has said what is wrong itself."""

    def __init__(self, process: str, exit_code: int) -> None:
        super().__init__(f"{process} can't start (exit code {exit_code})")
        self.exit_code = exit_code


class Watch:
    """One process through its lives. All times are seconds on one clock that never goes back."""

    def __init__(self, process: Process, config: SupervisorConfig) -> None:
        self.process = process
        self.restarts = 0
        self.restart_at_s: float | None = None  # set while it is down
        self.was_ready = False  # in any of its lives
        self._config, self._policy = config, RestartPolicy(config)
        self._pid = 0
        self._started_s = 0.0
        self._granted_s = 0.0  # until when the work may last that this life declared before it was ready
        self._ready_s: float | None = None  # when this life was first heard to be ready
        self._heartbeat: Heartbeat | None = None
        self._heard_s = 0.0
        self._last_exit = ""
        self._why_killed = ""
        self._hung_starts = 0  # killed before they were ready, since it was last ready
        self.asked_to_end_s: float | None = None  # when, for a start with another configuration
        self.on_trial = False  # started with another configuration, and not ready since
        self._trial_deaths = 0

    def configure(self, config: SupervisorConfig) -> None:
        """Other limits from now on."""
        self._config = config
        self._policy.configure(config)

    def started(self, pid: int, now_s: float) -> None:
        """It has been started, for the first time or again."""
        self.restarts += self._pid != 0
        self._pid, self._started_s, self.restart_at_s, self._heartbeat = pid, now_s, None, None
        self._ready_s, self._granted_s = None, now_s
        if self.asked_to_end_s is not None:
            self.on_trial, self._trial_deaths, self.asked_to_end_s = True, 0, None

    def heard(self, heartbeat: Heartbeat, now_s: float) -> None:
        """A heartbeat has come; one that a previous life left in the queue is ignored."""
        if heartbeat.pid == self._pid:
            self._heartbeat, self._heard_s = heartbeat, now_s
            self.was_ready |= self.ready
            if self.ready:
                self._hung_starts = 0
            if self.ready and self._ready_s is None:
                self._ready_s, self.on_trial = now_s, False
            if not self.ready and heartbeat.activity:
                busy_s = (heartbeat.monotonic_ns - heartbeat.activity_since_ns) * 1e-9
                self._granted_s = max(self._granted_s, now_s + heartbeat.budget_s - busy_s)

    def refuses(self, code: int) -> bool:
        """Whether an exit with this code says that the configuration just taken up is wrong.

        A user's error says so, and a second death of whatever kind: one may be chance. Neither where yet
        another configuration has come meanwhile. Ask before :meth:`exited`.
        """
        in_doubt = self.on_trial and self.asked_to_end_s is None
        return in_doubt and (code in USER_ERRORS or self._trial_deaths > 0)

    @property
    def is_unproven(self) -> bool:
        """Whether it may yet refuse the configuration just taken up."""
        return self.on_trial or self.asked_to_end_s is not None

    @property
    def state(self) -> str:
        """starting | ready | working | idle | ended, as it says itself, or restarting."""
        if self.restart_at_s is not None:
            return "restarting"
        return "starting" if self._heartbeat is None else self._heartbeat.state

    @property
    def ready(self) -> bool:
        """Whether it is running and has finished starting."""
        return self.state not in ("starting", "restarting")

    def healthy(self, now_s: float) -> bool:
        """Whether it is ready and heard of, or begins anew because it was told to."""
        if self.asked_to_end_s is not None:
            return True
        return self.ready and self.verdict(now_s).liveness == ALIVE

    def comes_back(self, now_s: float) -> bool:
        """Whether it was ready in an earlier life, and is heard of within the time that a start may take.

        Not where its last starts all hung. One that ended by itself, as without its camera, did not hang.
        """
        if self._hung_starts >= HUNG_STARTS:
            return False
        starts = self.was_ready and self._heartbeat is not None and self.state == "starting"
        return starts and self.verdict(now_s).liveness == ALIVE

    @property
    def lives(self) -> int:
        """How often it has been started."""
        return self.restarts + (self._pid != 0)

    def ended(self, source_ended_s: float | None) -> bool:
        """Whether it has done all that the recording caused.

        One that was not ready before the source had ended never heard of that, and has nothing to do.
        """
        if self.state == "ended":
            return True
        late = source_ended_s is not None and self._ready_s is not None and self._ready_s > source_ended_s
        return late and self.restarts > 0

    def verdict(self, now_s: float) -> Verdict:
        """Whether it lives, from its heartbeats and the time that it may take to start.

        That is ``start_s``, and longer where it declares work that takes longer, such as loading a network.
        A longer one than usual is for machines on which each such work takes longer, too.
        """
        if self.restart_at_s is not None:
            return Verdict(ALIVE)
        longer_s = max(self._config.start_s - USUAL_START_S, 0.0)
        verdict = judge(self._heartbeat, now_s - self._heard_s, longer_s)
        start_by_s = max(self._started_s + self._config.start_s, self._granted_s)
        if verdict.liveness != OVERDUE and not self.ready and now_s > start_by_s:
            return Verdict(OVERDUE, f"not ready after {start_by_s - self._started_s:.0f} s")
        return verdict

    def killed(self, why: str) -> None:
        """It is being killed for ``why``, which its exit is then put down to."""
        self._why_killed = why

    @property
    def is_being_killed(self) -> bool:
        """Whether it was killed and has not ended yet."""
        return bool(self._why_killed)

    def exited(self, code: int, now_s: float) -> str:
        """It has ended; says how. ``restart_at_s`` is when to start it again, now where it was told to end.

        Raises StartRefusedError for a user's error before it was ever ready, and SupervisionError when it
        died too often, or hung in too many starts in a row.
        """
        self._last_exit = describe_exit(code) + (f" ({self._why_killed})" if self._why_killed else "")
        self._hung_starts += bool(self._why_killed) and self._ready_s is None
        self._why_killed = ""
        if self.asked_to_end_s is not None:
            self.restart_at_s = now_s
            return self._last_exit
        self._trial_deaths += self.on_trial
        if code in USER_ERRORS and not self.was_ready:
            raise StartRefusedError(self.process.name, code)
        self._died(now_s)
        return self._last_exit

    def not_started(self, why: str, now_s: float) -> None:
        """It could not be started again, which counts as a death. Raises SupervisionError as it does."""
        self._last_exit = why
        self._died(now_s)

    def _died(self, now_s: float) -> None:
        pause, most = self._policy.died(now_s), self._config.max_restarts
        if pause is None or self._hung_starts > most:  # of such starts the window may hold one alone
            how_often = f"died more than {most} times within {self._config.window_s:g} s"
            if pause is not None:
                how_often = f"hung in {self._hung_starts} starts in a row"
            raise SupervisionError(
                f"{self.process.name} {how_often}, the last time with {self._last_exit}: giving up; "
                "its log lines above say why"
            )
        self.restart_at_s = now_s + pause

    def row(self, now_s: float) -> Row:
        """Its line on `health`."""
        verdict = self.verdict(now_s)
        if self.asked_to_end_s is not None:
            level, message = WARN, "starts anew with another configuration"
        elif self.restart_at_s is not None:
            level, message = ERROR, f"ended with {self._last_exit}; starting again"
        elif verdict.liveness != ALIVE:
            level, message = STALE if verdict.liveness == QUIET else ERROR, verdict.why
        elif not self.ready:
            level, message = WARN, "starting"
        elif self._heartbeat is not None and "warning" in self._heartbeat.values:
            level, message = WARN, self._heartbeat.values["warning"]
        else:
            level, message = OK, self.state
        values = {
            "state": self.state,
            "pid": str(self._pid),
            "restarts": str(self.restarts),
            "last_exit": self._last_exit,
        }
        if self._heartbeat is not None:
            values |= {"activity": self._heartbeat.activity, **self._heartbeat.values}
        return Row(self.process.name, level, message, values)
