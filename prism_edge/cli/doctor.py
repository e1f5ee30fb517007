"""`prism-edge doctor`: a line for each thing the daemon needs, and what to do where it is missing."""

from __future__ import annotations

import argparse
from typing import Any

from prism_edge.cli.settings import add_common, config_from


def add_parser(subparsers: Any, help_line: str) -> None:
    """Add the subcommand, with its line of `prism-edge --help`."""
    parser: argparse.ArgumentParser = subparsers.add_parser(
        "doctor",
        help=help_line,
        description="Check Python, native wheels, the depth network, Zenoh, certificates, limits, memory, "
        "disk and cameras: one line each, ok, warn or fail. Exits with 1 if anything fails.",
    )
    parser.add_argument("--model", metavar="MODEL", help="load and run this depth network too")
    add_common(parser)


def run(args: argparse.Namespace) -> int:
    """Print every finding as it is made; 1 if any is a failure."""
    from rich.console import Console

    from prism_edge.cli.checks import FAIL, OK, WARN, all_checks

    config = config_from(args)
    colours = {OK: "green", WARN: "yellow", FAIL: "bold red"}
    console = Console(highlight=False, soft_wrap=True, emoji=False)
    failed = 0
    for check in all_checks(config):
        for finding in check():
            failed += finding.level == FAIL
            advice = f"; {finding.advice}" if finding.advice else ""
            console.print(f"[{colours[finding.level]}]{finding.level:<5}[/]", end="")
            console.print(f"{finding.subject:<24}{finding.found}{advice}", markup=False)
    console.print(f"{failed} failed" if failed else "nothing failed")
    return 1 if failed else 0
