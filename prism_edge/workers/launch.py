"""Runs one worker in this process: configuration, priority, signals, bus, and an exit code at the end."""

from __future__ import annotations

import importlib
import logging
import os
import signal
import sys
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING

from setproctitle import setproctitle

from prism_edge.config import Config
from prism_edge.config_file import load
from prism_edge.errors import UNEXPECTED, BusError, PrismError, say
from prism_edge.processes import Process
from prism_edge.vital import end_starved, words_of_starved
from prism_edge.workers.heap import bound_heap, keep_trimmed
from prism_edge.workers.journald_log import JournalHandler, stderr_is_the_journal
from prism_edge.workers.stopping import StopSignals, die_with

if TYPE_CHECKING:
    from prism_edge.bus.session import Bus

TITLE = "prism-edge"  # and the worker's name, where ps shows a command line
_LOOK_S, _LINKED_S = 0.1, 1.0  # between looks for a link, and for one that needs no word
# -P, and no more than this package by its path: whatever lies in the folder that we are in.
_MODULE = (
    "import runpy, sys; sys.path.insert(0, sys.argv.pop(1)); import prism_edge; del sys.path[0]; "
    "runpy.run_module(sys.argv.pop(1), run_name='__main__', alter_sys=True)"
)


def own_module(name: str) -> list[str]:
    """A command line that runs a module of this very package, of a checkout that is not installed, too."""
    return [sys.executable, "-P", "-c", _MODULE, str(Path(__file__).absolute().parents[2]), name]


def log_to_stderr(process: str, level: int = logging.INFO) -> None:
    """One line of text for each event, with the name of the process."""
    logging.basicConfig(
        level=level,
        stream=sys.stderr,
        force=True,
        format=f"%(asctime)s.%(msecs)03d %(levelname)-7s {process}: %(message)s",
        datefmt="%H:%M:%S",
    )


def log_as_configured(process: str, config: Config) -> None:
    """Log as ``config.log`` says, to the journal or in text on stderr."""
    level = getattr(logging, config.log.level.upper())
    log_to_stderr(process, level)
    wanted = config.log.form
    if wanted == "journal" or (wanted == "auto" and stderr_is_the_journal()):
        try:
            handler = JournalHandler({"PRISM_PROCESS": process, "PRISM_ROBOT": config.robot})
        except OSError as error:
            log = logging.getLogger("prism_edge")
            log.warning("no journal to log to (%s): logging in text", error.strerror or error)
            return
        handler.setFormatter(logging.Formatter(f"{process}: %(message)s"))
        logging.basicConfig(level=level, handlers=[handler], force=True)


def silence_stdout() -> None:
    """What is to be read goes to stderr; gtsam prints each point that slips behind a camera in a solve."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    if nowhere != 1:  # else it was closed before, and stays taken
        os.dup2(nowhere, 1)
        os.close(nowhere)


def say_when_linked(bus: Bus, endpoint: str, log: logging.Logger) -> None:
    """Log that the bus is there, and before it, where that takes a while, that nobody listens yet."""
    silent_until_s: float | None = time.monotonic() + _LINKED_S
    while not bus.is_linked():
        if silent_until_s is not None and time.monotonic() > silent_until_s:
            silent_until_s = None
            log.info("waiting for a listener at %s", endpoint)
        if bus.stopped.wait(_LOOK_S):
            return
    log.info("on the bus at %s", endpoint)


def alike(config: Config) -> dict[str, str]:
    """What must be in a worker's configuration as it is in the robot's; shown on `health`, compared there."""
    return {"mode": config.mode, "depth.model": "a network" if config.depth.network else "empty"}


def joined(config: Config, name: str, signals: StopSignals, is_again: bool) -> Bus | None:
    """The bus; None where it was told to stop meanwhile.

    Once there was a run of the robot's (``is_again``), from another host, too, the next is waited for. Raises
    as :meth:`Bus.open` does.
    """
    from prism_edge.bus.session import Bus

    while True:
        try:
            return Bus.open(config, name)
        except BusError:
            if not is_again:
                raise
        if signals.stopped.wait(_LINKED_S):
            return None


def watch_for_another_run(bus: Bus) -> threading.Event:
    """Stop the bus once the robot has begun another run, which the event then says."""
    another = threading.Event()

    def begins() -> None:
        another.set()
        bus.stopped.set()

    bus.on_another_run(begins)
    return another


def run_worker(process: Process, config_file: str, parent: int | None = None, life: int = 0) -> int:
    """Run ``process`` until it is told to stop; returns the exit code.

    ``parent`` is the process id of the supervisor that started it: the worker dies with it. ``life`` is how
    often it was started before: what it numbers must not be taken for what an earlier life numbered.

    A user's error is one line on stderr and its own code; anything else is logged with its traceback and
    gives 70.
    """
    if parent is not None:
        die_with(parent)
        setproctitle(f"{TITLE} {process.name}")
        silence_stdout()
    bound_heap()
    # In a terminal's background, where `stty tostop` would stop whoever writes a line.
    signal.signal(signal.SIGTTOU, signal.SIG_IGN)
    signals = StopSignals()
    signals.listen()
    log_to_stderr(process.name)
    log = logging.getLogger(f"prism_edge.{process.name}")
    starved = words_of_starved(f"prism-edge {process.name}")
    try:
        config = load(config_file)
        log_as_configured(process.name, config)
        os.nice(process.nice)
        # Imported late, as each worker stands on libraries that the others need not load.
        main = importlib.import_module(process.module).main
        if "cv2" in sys.modules:  # else the environment sees to it
            sys.modules["cv2"].setNumThreads(1)
        another: threading.Event | None = None
        while another is None or (another.is_set() and not signals.stopped.is_set()):
            if another is not None:
                log.info("the robot has begun another run: beginning anew")
            bus_of_run = joined(config, process.name, signals, is_again=another is not None)
            if bus_of_run is None:
                break
            another = threading.Event()
            with bus_of_run as bus:
                if parent is None:  # by hand: without a listener it waits, which would look like nothing
                    told = bus, config.bus.endpoint, log
                    threading.Thread(target=say_when_linked, args=told, name="linked", daemon=True).start()
                    another = watch_for_another_run(bus)
                    bus.pulse.values.update(alike(config))
                bus.begin_life(None if parent is None else life)
                bus.run_directory = Path(config_file).resolve().parent if parent is not None else None
                signals.also(bus.stopped)
                keep_trimmed(bus.stopped)
                try:
                    main(config, bus)
                except Exception as error:
                    if type(error) is MemoryError:  # numpy's is of one array that is too large
                        end_starved(starved)
                    if not another.is_set() or signals.stopped.is_set():
                        raise
                    log.info("the last run's work ended with %s: %s", type(error).__name__, error)
        if not signals.stopped.is_set():
            log.error("ended without being told to")
        return 0
    except PrismError as error:
        say(f"prism-edge {process.name}: error: {error}")
        return error.exit_code
    except Exception:
        log.exception("unexpected error; please report it with the lines below")
        return UNEXPECTED
