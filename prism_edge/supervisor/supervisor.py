"""Starts the workers, watches them, starts the dead again, and ends them all."""

from __future__ import annotations

import contextlib
import logging
import os
import time
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import TYPE_CHECKING

from prism_edge.bus.access import check_network
from prism_edge.bus.keys import check_loopback, check_robot_name
from prism_edge.bus.vacancy import can_listen
from prism_edge.config import NO_NETWORK, Config
from prism_edge.config_file import dump
from prism_edge.errors import SupervisionError, in_words
from prism_edge.processes import Process, processes_for
from prism_edge.supervisor.child import Child
from prism_edge.supervisor.health import ERROR, Row, no_network, status_line, summary
from prism_edge.supervisor.kept_journal import KeptJournal
from prism_edge.supervisor.liveness import OVERDUE, QUIET_S
from prism_edge.supervisor.metrics import MetricsServer, check_port
from prism_edge.supervisor.namesakes import Namesakes, words
from prism_edge.supervisor.reload import difference
from prism_edge.supervisor.remote import RemoteWatch
from prism_edge.supervisor.run_directory import RunDirectory
from prism_edge.supervisor.start import Start, start_worker
from prism_edge.supervisor.watch import StartRefusedError, Watch
from prism_edge.workers.configured_network import CONFIG
from prism_edge.workers.launch import alike

if TYPE_CHECKING:
    from prism_edge.bus.commands import Reply
    from prism_edge.messages import Heartbeat

log = logging.getLogger("prism_edge.supervisor")

LOOK_S = 0.1  # a death is noticed within this
HEALTH_S = 1.0
PAUSED_S = 1.0  # a round later than this: we were stopped ourselves, and heartbeats with us


class Supervisor:
    """The processes of one run. Use it as a context manager from the thread that outlives the run.

    ``processes`` and ``start`` (what starts each of them) default to what the configuration asks for.
    """

    def __init__(
        self,
        config: Config,
        processes: Sequence[Process] | None = None,
        start: Start = start_worker,
    ) -> None:
        self._config, self._start = config, start
        chosen = processes_for(config) if processes is None else processes
        away = config.network.remote
        self._watches = {p.name: Watch(p, config.supervisor) for p in chosen if p.name not in away}
        self.started_s = time.monotonic()
        same = alike(config)
        self._remote = {p.name: RemoteWatch(p.name, self.started_s, same) for p in chosen if p.name in away}
        self._children: dict[str, Child] = {}
        self._cleanup = contextlib.ExitStack()
        self.ready_s: float | None = None  # seconds from construction until every process was ready
        self._published_s = -HEALTH_S
        self._essence: list[tuple[str, int, str, str]] = []
        self._source_ended_s: float | None = None
        self._looked_s = self.started_s
        self._lenient_until_s = 0.0
        self._namesakes = Namesakes()
        self._certificates: dict[str, str] = {}  # what was in their files at the start
        self._of_two: list[str] = []  # processes that are heard from another daemon, too
        self._status = "starting"
        self._rows: list[Row] = []  # the latest
        self._before = config  # the last that every process has taken up
        self._journal = KeptJournal(config)
        self._ended_well = False

    def __enter__(self) -> Supervisor:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if isinstance(error, SupervisionError):
            self._journal.gave_up()
        if isinstance(error, StartRefusedError):
            self._journal.refused()
        self.stop()

    @property
    def processes(self) -> dict[str, int]:
        """Process id of every worker that runs."""
        return {name: child.pid for name, child in self._children.items() if child.exit_code is None}

    @property
    def ready(self) -> bool:
        """Whether every process is ready at this moment."""
        return all(watch.ready for watch in self._watches.values())

    @property
    def healthy(self) -> bool:
        """Whether every process without which no poses flow is ready and heard of."""
        now = time.monotonic()
        return all(watch.healthy(now) for watch in self._watches.values() if watch.process.required)

    @property
    def alive(self) -> bool:
        """Whether every such process is healthy, or on its way to it: a restart of all would gain nothing."""
        now = time.monotonic()
        required = [watch for watch in self._watches.values() if watch.process.required]
        return all(watch.healthy(now) or watch.comes_back(now) for watch in required)

    @property
    def stop_s(self) -> float:
        """How long :meth:`stop` gives the processes."""
        return self._config.supervisor.stop_s

    @property
    def status(self) -> str:
        """The run in one line."""
        return self._status

    @property
    def ended(self) -> bool:
        """Whether the recording is over and every process has done all that followed from it."""
        return all(watch.ended(self._source_ended_s) for watch in self._watches.values())

    def start(self) -> None:
        """Open the bus's listener and start every process.

        Raises ConfigError for the robot's name or the metrics' port, and BusError for the endpoint, with
        nothing left behind.
        """
        check_robot_name(self._config.robot)
        check_loopback(self._config.bus.endpoint)
        check_network(self._config.network, self._config.bus.endpoint)
        if self._config.network.endpoint:
            from prism_edge.bus.certificates import contents, mismatch  # which loads OpenSSL

            self._certificates = contents(self._config.network)
            if wrong := mismatch(self._config.network):
                log.warning("nobody is going to link over the network: %s", wrong)
        check_port(self._config)
        if not self._config.depth.network:
            log.warning("depth %s", no_network().message)
        try:
            metrics = None
            if self._config.metrics.port:  # before any process: where the port is taken, none need be ended
                metrics = MetricsServer(self._config.metrics.port, lambda: self._rows)
            self._directory = RunDirectory()
            self._cleanup.callback(self._directory.remove)
            self._directory.write(CONFIG, dump(self._config))
            self._cleanup.callback(self._journal.release)
            self._journal.claim(self._directory)
            # Before we have threads, so that they can be forks; but none may join a stranger's listener.
            early = can_listen(self._config.bus.endpoint)
            if early:
                self._launch_all()
            self._open_bus()
            if not early:
                self._launch_all()
            if metrics is not None:
                metrics.start()
                self._cleanup.callback(metrics.close)
        except BaseException:
            self._journal.refused()
            self.stop()
            raise

    def run(self, until: Callable[[], bool]) -> None:
        """Watch over the processes until ``until()`` holds.

        Raises StartRefusedError when a worker can't start for a reason that only the user can mend, and
        SupervisionError when one keeps dying.
        """
        while not until():
            self._look()

    def reload(self, wanted: Config) -> None:
        """Take up what can change of another configuration; the rest is refused, with a line in the log.

        Raises OSError where it can't be written for the processes: then nothing has changed.
        """
        change = difference(self._config, wanted)
        self._directory.write(CONFIG, dump(change.config))
        if change.refused:
            log.warning("not reloaded, as only a restart changes it: %s", " ".join(change.refused))
        if change.elsewhere:
            log.warning("not reloaded, as it changes where the process runs: %s", " ".join(change.elsewhere))
        if self._certificates:
            self._tell_of_renewed()
        if change.behind:
            names = " ".join(sorted(change.behind))
            log.warning("to be started anew where it runs, with the same settings: %s", names)
        log.info("reloaded: %s", " ".join(change.applied) or "nothing has changed")
        if not any(watch.is_unproven for watch in self._watches.values()):
            self._before = self._config
        self._config = change.config
        for name, watch in self._watches.items():
            watch.configure(self._config.supervisor)
            if name in change.restart and watch.asked_to_end_s is None:
                watch.asked_to_end_s = time.monotonic()  # also of one that is down: its next start is a trial
                self._children[name].terminate()

    def ended_well(self) -> None:
        """The run ends as it should: no other goes on in its map. Call before :meth:`stop`, or not at all."""
        self._ended_well = True
        again = [name for name, watch in self._watches.items() if watch.restarts]
        if again and self._config.is_lockstep:
            log.warning("not the run that lockstep repeats: %s died and was started again", ", ".join(again))

    def stop(self) -> None:
        """End every process within ``supervisor.stop_s``, then close the bus and remove the run's files."""
        if self._ended_well:  # first: a manager may have less patience than ``stop_s``
            self._journal.ended()
        running = [child for child in self._children.values() if child.poll() is None]
        for child in running:
            child.terminate()
        deadline = time.monotonic() + self.stop_s
        while running and time.monotonic() < deadline:
            time.sleep(0.02)
            running = [child for child in running if child.poll() is None]
        for name, child in self._children.items():
            if child.exit_code is None:
                log.warning("%s did not end in %g s and is killed", name, self.stop_s)
                child.kill()
        self._cleanup.close()

    def _open_bus(self) -> None:
        from prism_edge.bus import ros
        from prism_edge.bus.session import Bus

        self._bus = Bus.open(self._config, "supervisor", listen=True)
        self._cleanup.callback(self._bus.close)
        self._heartbeats = self._bus.queue("heartbeat", capacity=1024)
        self._diagnostics = ros.diagnostics
        self._desk = self._bus.commands({"info": self._info})
        self._bus.pulse.ready()

    def _launch_all(self) -> None:
        for name in self._watches:
            self._launch(name)

    def _launch(self, name: str) -> None:
        watch = self._watches[name]
        self._directory.restore()
        child = self._start(watch.process, self._directory.path / CONFIG, watch.lives)
        self._children[name] = child
        watch.started(child.pid, time.monotonic())

    def _launch_again(self, name: str, watch: Watch, now: float) -> None:
        try:
            self._launch(name)
        except OSError as error:  # no process, or no run's folder, for the moment
            log.error("%s can't be started: %s", name, in_words(error))
            watch.not_started(in_words(error), now)
        else:
            log.info("%s started again (process %d)", name, self._children[name].pid)

    def _look(self) -> None:
        """One round: hear, collect the dead, kill the hung, start again, publish."""
        first = self._heartbeats.take(timeout_s=LOOK_S)
        now = time.monotonic()
        for heartbeat in [first, *self._heartbeats.drain()]:
            if heartbeat is not None:
                self._hear(heartbeat, now)
        for remote in self._remote.values():
            remote.tell(now)
        self._tell_of_namesakes(now)
        self._desk.serve()
        if now - self._looked_s > PAUSED_S:
            self._lenient_until_s = now + QUIET_S
        self._looked_s = now
        for name, watch in self._watches.items():
            self._look_at(name, watch, now)
        if self.ready_s is None and self.ready:
            self.ready_s = now - self.started_s
            log.info("ready after %.2f s: %s", self.ready_s, " ".join(self._watches))
        self._publish(now)
        self._journal.alive()
        self._directory.keep()

    def _hear(self, heartbeat: Heartbeat, now: float) -> None:
        name = heartbeat.process
        if name in self._remote or name in self._watches:  # of subscribers, as `watch`, there may be many
            self._namesakes.heard(heartbeat, now)
        if name in self._remote:
            self._remote[name].heard(heartbeat, now)
        if name in self._watches:
            self._watches[name].heard(heartbeat, now)
            # By its watch, which hears only the process that was started: another may say so too.
            if name == "source" and self._watches[name].state == "ended":
                self._source_ended_s = self._source_ended_s or now

    def _tell_of_namesakes(self, now: float) -> None:
        before, self._of_two = self._of_two, self._namesakes.there(now)
        if self._of_two and not before:
            log.error("%s", words(self._config.robot, self._of_two))

    def _tell_of_renewed(self) -> None:
        from prism_edge.bus.certificates import contents

        now = contents(self._config.network)
        if renewed := [key for key, digest in now.items() if digest != self._certificates[key]]:
            log.warning("not reloaded, as only a restart reads its file again: %s", " ".join(renewed))

    def _look_at(self, name: str, watch: Watch, now: float) -> None:
        if watch.restart_at_s is not None:
            if now >= watch.restart_at_s:
                self._launch_again(name, watch, now)
            return
        child = self._children[name]
        verdict = watch.verdict(now)
        if verdict.liveness == OVERDUE and now >= self._lenient_until_s and child.poll() is None:
            if not watch.is_being_killed:  # else a driver holds it: once it lets go, it is gone
                log.error("%s hangs (%s) and is killed", name, verdict.why)
                watch.killed(verdict.why)
            child.kill()
        asked_s = watch.asked_to_end_s
        if asked_s is not None and now - asked_s > self.stop_s:
            child.kill()
        code = child.poll()
        if code is not None:
            if watch.refuses(code) and self._config != self._before:
                log.error("%s refuses what was reloaded: going back to the configuration before it", name)
                self._go_back()  # which asks it to end, as it has: what is wrong is no death of its own
            asked = watch.asked_to_end_s is not None
            how = watch.exited(code, now)
            if not asked:
                log.error("%s ended with %s; starting it again", name, how)

    def _go_back(self) -> None:
        try:
            self.reload(self._before)
        except OSError as error:
            log.error("can't go back: %s", in_words(error))

    def _info(self, argument: str) -> Reply:
        """The command `info`: refused, so to say, where what poses need is not up, or no map can be.

        A camera that is away, a pause and a recording's end are said alone: no restart would mend them.
        """
        from prism_edge import __version__
        from prism_edge.bus.commands import Reply
        from prism_edge.sources.address import shown_address

        now = time.monotonic()
        values = {
            "version": __version__,
            "robot": self._config.robot,
            "mode": self._config.mode,
            "input": shown_address(self._config.source.uri),
            "model": self._config.depth.network or NO_NETWORK,
            "up_s": f"{now - self.started_s:.0f}",
        }
        rows = {name: watch.row(now) for name, watch in self._watches.items()}
        rows |= {name: remote.row(now) for name, remote in self._remote.items()}
        if "depth" in rows:
            values["provider"] = rows["depth"].values.get("provider", "none")
        values |= {name: row.message for name, row in rows.items()}
        if not self._config.depth.network:
            values["depth"] = no_network(self._has_map(now)).message
        return Reply(self.ready_s is not None and self.alive and self._has_map(now), self._status, values)

    def _has_map(self, now_s: float) -> bool:
        """Whether there is a map for poses, or a network to begin one; a loaded map needs none."""
        from prism_edge.messages import INITIALISING

        if self._config.depth.network or "tracker" not in self._watches:
            return True
        return self._watches["tracker"].row(now_s).values.get("odometry", INITIALISING) != INITIALISING

    def _publish(self, now: float) -> None:
        rows: list[Row] = [watch.row(now) for watch in self._watches.values()]
        rows += [remote.row(now) for remote in self._remote.values()]
        if not self._config.depth.network:
            rows.append(no_network(self._has_map(now)))
        if self._of_two:
            rows.append(Row("robot", ERROR, words(self._config.robot, self._of_two), {}))
        rows.insert(0, summary(rows, os.getpid(), self.ready_s))
        self._status, self._rows = status_line(rows), rows
        essence = [row.essence for row in rows]
        if essence != self._essence or now - self._published_s >= HEALTH_S:
            self._essence, self._published_s = essence, now
            statuses = [(row.name, row.level, row.message, row.values) for row in rows]
            self._bus.publish("health", self._diagnostics(time.time_ns(), statuses))
