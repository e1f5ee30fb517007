"""`prism-edge config`: what is in effect, and whether a file is right."""

from __future__ import annotations

import argparse
import sys
from typing import Any

from prism_edge.cli.settings import add_common, add_input, config_from
from prism_edge.config_file import dump
from prism_edge.errors import ConfigError


def add_parser(subparsers: Any, help_line: str) -> None:
    """Add the subcommand, with its line of `prism-edge --help`."""
    parser: argparse.ArgumentParser = subparsers.add_parser(
        "config",
        help=help_line,
        description="Print the whole configuration as it results from defaults, --config and options: YAML "
        "that --config takes back. With --check, only say whether a file is right, with the options "
        "beside it, and warn of what `run` would miss on this machine.",
    )
    add_input(parser)
    add_common(parser)
    parser.add_argument("--explain", action="store_true", help="write each key's meaning beside it")
    parser.add_argument("--check", metavar="FILE", help="check FILE in --config's place, print nothing else")


def run(args: argparse.Namespace) -> int:
    """Print or check; returns the exit code. Raises PrismError for anything wrong."""
    if args.check is not None:
        from prism_edge.cli.check import check_config

        if args.config is not None:
            raise ConfigError(f"--check {args.check} is itself the file of --config: leave that out")
        args.config = args.check
        for warning in check_config(config_from(args)):
            print(f"{args.check}: warning: {warning}", file=sys.stderr)
        print(f"{args.check}: ok")
    else:
        print(dump(config_from(args), args.explain), end="")
    return 0
