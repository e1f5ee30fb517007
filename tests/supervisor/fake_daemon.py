"""A whole daemon of fake workers: ``fake_daemon.py CONFIG NAME:BEHAVIOUR...``; prints `ready` when it is."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from prism_edge.config_file import load
from prism_edge.errors import PrismError
from prism_edge.processes import Process
from prism_edge.supervisor import supervise
from prism_edge.supervisor.child import Child
from prism_edge.supervisor.start import Start
from prism_edge.supervisor.supervisor import Supervisor
from prism_edge.workers.launch import log_to_stderr

WORKER = Path(__file__).with_name("fake_worker.py")


def cast(behaviours: Sequence[str]) -> tuple[list[Process], Start]:
    """The processes and what starts them, from ``NAME:BEHAVIOUR`` texts."""
    plan = dict(text.split(":", 1) for text in behaviours)

    def start(process: Process, config_file: Path, life: int) -> Child:
        behaviour = plan[process.name]
        command = [sys.executable, str(WORKER), process.name, behaviour, str(config_file), str(os.getpid())]
        return Child.spawn(command)

    return [Process(name, "fake_worker", "pretends", required=True) for name in plan], start


class Telling(Supervisor):
    """Prints each worker's process id once all are ready."""

    def run(self, until: Callable[[], bool]) -> None:
        told = False

        def until_told() -> bool:
            nonlocal told
            if self.ready_s is not None and not told:
                told = True
                print("ready", *(f"{name}={pid}" for name, pid in self.processes.items()), flush=True)
            return until()

        super().run(until_told)


if __name__ == "__main__":
    log_to_stderr("supervisor")
    processes, start = cast(sys.argv[2:])
    try:
        file = sys.argv[1]
        supervise.Supervisor = Telling  # type: ignore[misc]
        sys.exit(
            supervise.supervise(load(file), processes=processes, start=start, reread=lambda: load(file))
        )
    except PrismError as error:
        print(f"prism-edge: error: {error}", file=sys.stderr, flush=True)
        sys.exit(error.exit_code)
