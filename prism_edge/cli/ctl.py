"""`prism-edge ctl`: tell a running daemon to do something, and hear what came of it."""

from __future__ import annotations

import argparse
from typing import Any

from prism_edge.cli.settings import add_common, config_from, seconds_above_zero
from prism_edge.topics import COMMANDS

REFUSED = 1


def add_parser(subparsers: Any, help_line: str) -> None:
    """Add the subcommand, with its line of `prism-edge --help`."""
    lines = []
    for command in COMMANDS.values():
        shown = f"{command.name} [{command.argument}]" if command.argument else command.name
        lines.append(f"  {shown:<26} {command.does}")
    parser: argparse.ArgumentParser = subparsers.add_parser(
        "ctl",
        help=help_line,
        description="Send a command to a running daemon and print what came of it. Exits with 1 where it was "
        "refused, with 6 where nobody answers.\n\n" + "\n".join(lines),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("name", metavar="COMMAND", choices=list(COMMANDS), help=", ".join(COMMANDS))
    parser.add_argument("argument", metavar="ARGUMENT", nargs="?", help="the command's one word")
    parser.add_argument(
        "--timeout", metavar="S", type=seconds_above_zero, default=10.0, help="wait this long (10)"
    )
    parser.add_argument("--json", action="store_true", help="print the reply as it came")
    parser.add_argument("--quiet", action="store_true", help="print no answer: the exit code says it")
    add_common(parser)


def run(args: argparse.Namespace) -> int:
    """Ask, and print the answer; returns the exit code. Raises BusError where nobody answers."""
    from prism_edge.bus.commands import pack_reply, send
    from prism_edge.bus.keys import check_robot_name
    from prism_edge.bus.links import open_session

    config = config_from(args)
    check_robot_name(config.robot)
    with open_session(config.bus, listen=False, client=True, network=config.network) as session:
        reply = send(session, config.robot, COMMANDS[args.name], args.argument, args.timeout)
    if args.quiet:
        pass
    elif args.json:
        print(pack_reply(reply).decode())
    else:
        print(reply.said)
        width = max(map(len, reply.values), default=0)
        for name, value in reply.values.items():
            print(f"  {name:<{width}}  {value}")
    return 0 if reply.ok else REFUSED
