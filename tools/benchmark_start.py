"""What forking workers saves: the daemon's start with workers as forks and as programs of their own, in turn.

    python tools/benchmark_start.py [--rounds N] [SOURCE MODEL]

SOURCE and MODEL default to a simulated room and prism_nano. Prints the median (least to most) of each way and
the ratio of the medians: seconds from the program's start until it is ready, CPU time of all processes until
a second later, and their memory then.
"""

from __future__ import annotations

import argparse
import statistics
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import psutil

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from prism_edge.bus.vacancy import free_endpoint
from prism_edge.config import BusConfig, Config, DepthConfig, SourceConfig, StateConfig
from prism_edge.config_file import dump, load
from prism_edge.evaluation.resources import pss_mb

WAYS = ("forks", "programs")
FIGURES = ("ready s", "CPU s", "memory MB")
READY = "ready after"


def supervised(way: str, file: str) -> int:
    """The daemon itself, in a process of its own."""
    from prism_edge.supervisor.start import spawn_worker, start_worker
    from prism_edge.supervisor.supervise import supervise
    from prism_edge.workers.launch import log_to_stderr

    log_to_stderr("supervisor")
    return supervise(load(file), start=start_worker if way == "forks" else spawn_worker)


def measured(way: str, config: Config, folder: Path) -> tuple[float, float, float]:
    """One start: seconds until ready, and CPU seconds and MB a second later."""
    file = folder / "config.yaml"
    file.write_text(dump(replace(config, bus=BusConfig(free_endpoint()))))
    began = time.monotonic()
    command = [sys.executable, __file__, "--daemon", way, str(file)]
    daemon = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    try:
        assert daemon.stderr is not None
        said = []
        for line in daemon.stderr:
            said.append(line)
            if READY in line:
                break
        else:
            raise SystemExit(f"the daemon did not start:\n{''.join(said)}")
        ready_s = time.monotonic() - began
        time.sleep(1.0)
        root = psutil.Process(daemon.pid)
        family = [root, *root.children(recursive=True)]
        cpu_s = sum(sum(process.cpu_times()[:2]) for process in family)
        return ready_s, cpu_s, sum(pss_mb(process.pid) or 0.0 for process in family)
    finally:
        daemon.terminate()
        daemon.communicate()


def main() -> int:
    """Measure, print, return the exit code."""
    as_written = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=as_written)
    parser.add_argument("given", nargs="*", metavar="SOURCE MODEL")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--daemon", choices=WAYS, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.daemon:
        return supervised(args.daemon, *args.given)
    if len(args.given) not in (0, 2) or args.rounds < 1:
        parser.error("give SOURCE and MODEL or neither, and one round or more")
    source, model = args.given or ("sim:room", "prism_nano")
    with tempfile.TemporaryDirectory() as name:
        config = Config(
            source=SourceConfig(source, wait_s=60.0),  # what is measured is the start, not the first images
            depth=DepthConfig(model=model),
            state=StateConfig(directory=name),
        )
        found: dict[str, list[tuple[float, float, float]]] = {way: [] for way in WAYS}
        for i in range(args.rounds):
            for way in WAYS:
                found[way].append(measured(way, config, Path(name)))
            print(f"round {i + 1} of {args.rounds}", file=sys.stderr)
    print(f"| | {' | '.join(WAYS)} | ratio |\n|---|---|---|---|")
    for i, figure in enumerate(FIGURES):
        columns = [[run[i] for run in found[way]] for way in WAYS]
        shown = [f"{statistics.median(c):.2f} ({min(c):.2f} to {max(c):.2f})" for c in columns]
        ratio = statistics.median(columns[0]) / statistics.median(columns[1])
        print(f"| {figure} | {' | '.join(shown)} | {ratio:.2f} |")
    return 0


if __name__ == "__main__":
    sys.exit(main())
