"""A whole run in the foreground: from start to SIGTERM, Ctrl-C or the end of the recording."""

from __future__ import annotations

import logging
import resource
import signal
import time
from collections.abc import Callable, Sequence
from contextlib import suppress

from prism_edge.config import Config
from prism_edge.errors import PrismError, in_words
from prism_edge.processes import Process
from prism_edge.supervisor.notify import Notifier
from prism_edge.supervisor.start import Start, start_worker
from prism_edge.supervisor.supervisor import Supervisor
from prism_edge.supervisor.watch import StartRefusedError
from prism_edge.workers.stopping import StopSignals

log = logging.getLogger("prism_edge.supervisor")

STARTS = 2.0  # times start_s: a start that hung once may still become one; the units' TimeoutStartSec
DESCRIPTORS = 65_536  # the units' LimitNOFILE
CLOSING_S = 5.0  # for what comes after the processes have ended


def supervise(
    config: Config,
    stay: bool = True,
    processes: Sequence[Process] | None = None,
    start: Start = start_worker,
    reread: Callable[[], Config] | None = None,
) -> int:
    """Run the daemon until SIGTERM or SIGINT; returns the exit code. Call from the main thread.

    SIGHUP takes up what can change of the configuration that ``reread`` returns; where that raises, one line
    says why and nothing changes. A service manager (systemd) is told how the run is.

    Without ``stay`` the run also ends when the recording has, and all that followed from it is done; a
    recording that loops never does. A worker that refuses to start has said why in a line of its own: its
    exit code is returned. Raises BusError for the listener and SupervisionError for a process that keeps
    dying; nothing is left running in any case.
    """
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)  # a parent's `ignore` is inherited: children would be lost
    allow_descriptors()
    signals = StopSignals(reload=reread is not None)
    notifier = Notifier()
    notifier.starting(STARTS * config.supervisor.start_s)
    announced = False

    def finished() -> bool:
        nonlocal announced
        if supervisor.ready_s is not None and not announced:
            announced = True
            notifier.ready()
        if reread is not None and signals.reload_wanted.is_set():
            signals.reload_wanted.clear()
            _reload(supervisor, reread, notifier, announced)
        notifier.status(supervisor.status)
        if supervisor.alive:
            notifier.feed(time.monotonic())
        return signals.stopped.is_set() or (not stay and supervisor.ended)

    try:
        with Supervisor(config, processes, start) as supervisor:
            signals.listen()  # in a thread; before it there was none, and workers could be forks
            try:
                supervisor.run(finished)
                supervisor.ended_well()
            finally:
                notifier.stopping(supervisor.stop_s + CLOSING_S)
            log.info("stopping" if signals.stopped.is_set() else "the recording has ended; stopping")
    except StartRefusedError as error:
        log.error("%s; stopped", error)
        return error.exit_code
    finally:
        notifier.send_what_waits()
    return 0


def allow_descriptors() -> None:
    """As many open files as may be, up to :data:`DESCRIPTORS`: connections take one each before they say who.

    Once none is left Zenoh's TLS listener frees none, and the bus is deaf for good.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    most = DESCRIPTORS if hard == resource.RLIM_INFINITY else min(hard, DESCRIPTORS)
    if soft != resource.RLIM_INFINITY and soft < most:
        with suppress(ValueError, OSError):  # a system's own limit may be below
            resource.setrlimit(resource.RLIMIT_NOFILE, (most, hard))


def _reload(
    supervisor: Supervisor, reread: Callable[[], Config], notifier: Notifier, announced: bool
) -> None:
    """Told to the manager from beginning to end; a user's error and a full disk leave all as it was."""
    if announced:
        notifier.reloading()
    try:
        supervisor.reload(reread())
    except (PrismError, OSError) as error:
        log.error("not reloaded: %s", in_words(error))
    if announced:
        notifier.ready()
