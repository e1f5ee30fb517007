"""`prism-edge config`: what is in effect, and whether a file is right."""

from __future__ import annotations

import argparse
import sys
from typing import Any

from prism_edge.cli.settings import add_common, add_input, config_from
from prism_edge.config_file import dump, load


def add_parser(subparsers: Any, help_line: str) -> None:
    """Add the subcommand, with its line of `prism-edge --help`."""
    parser: argparse.ArgumentParser = subparsers.add_parser(
        "config",
        help=help_line,
        description="Print the whole configuration as it results from defaults, --config and options: YAML "
        "that --config takes back. With --check, only say whether a file is right, and warn "
        "of what `run` would miss on this machine.",
    )
    add_input(parser)
    add_common(parser)
    parser.add_argument("--explain", action="store_true", help="write each key's meaning beside it")
    parser.add_argument("--check", metavar="FILE", help="check FILE and print nothing else")


def run(args: argparse.Namespace) -> int:
    """Print or check; returns the exit code. Raises PrismError for anything wrong."""
    if args.check is not None:
        from prism_edge.cli.check import check_config

        for warning in check_config(load(args.check)):
            print(f"{args.check}: warning: {warning}", file=sys.stderr)
        print(f"{args.check}: ok")
    else:
        print(dump(config_from(args), args.explain), end="")
    return 0
