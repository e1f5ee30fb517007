"""``python -m prism_edge.workers NAME --config FILE``: run one process alone."""

from __future__ import annotations

import argparse
import sys

from prism_edge.bus.leaving import ended
from prism_edge.processes import PROCESSES
from prism_edge.workers.launch import run_worker


def main(arguments: list[str] | None = None) -> int:
    """Run the worker that the command line names; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m prism_edge.workers", description=__doc__)
    parser.add_argument("name", choices=list(PROCESSES), help="which process")
    parser.add_argument("--config", metavar="FILE", required=True, help="the effective configuration (YAML)")
    parser.add_argument("--parent", metavar="PID", type=int, help="die with this process, which started us")
    parser.add_argument("--life", metavar="N", type=int, default=0, help="how often it was started before")
    args = parser.parse_args(arguments)
    return run_worker(PROCESSES[args.name], args.config, args.parent, args.life)


if __name__ == "__main__":
    sys.exit(ended(main()))
