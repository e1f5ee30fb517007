"""`prism-edge worker`: one process alone, on this host or another."""

from __future__ import annotations

import argparse
from typing import Any

from prism_edge.processes import PROCESSES


def add_parser(subparsers: Any, help_line: str) -> None:
    """Add the subcommand, with its line of `prism-edge --help`."""
    does = "\n".join(f"  {process.name:<8} {process.does}" for process in PROCESSES.values())
    parser: argparse.ArgumentParser = subparsers.add_parser(
        "worker",
        help=help_line,
        description="Run one process in the foreground; it joins the bus at bus.endpoint, where a listener "
        f"(the supervisor's, or a Zenoh router) must be.\n\n{does}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("name", metavar="NAME", choices=list(PROCESSES), help=", ".join(PROCESSES))
    parser.add_argument(
        "--config", metavar="FILE", required=True, help="effective configuration (`prism-edge config ...`)"
    )


def run(args: argparse.Namespace) -> int:
    """Run the worker; returns its exit code."""
    from prism_edge.workers.launch import run_worker

    return run_worker(PROCESSES[args.name], args.config)
