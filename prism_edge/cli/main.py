"""`prism-edge`: finds the subcommand, runs it, and turns errors into one line and an exit code."""

from __future__ import annotations

import argparse
import importlib
import sys
from typing import Any

from prism_edge import __version__
from prism_edge.bus.leaving import ended
from prism_edge.cli.streams import drop_output, open_closed, print_anything
from prism_edge.errors import report
from prism_edge.huge_pages import begin_with_huge_pages

# Name: module, one line of help. Only the module that is asked for is imported, so that help comes at once.
COMMANDS = {
    "run": ("prism_edge.cli.run", "run the daemon on a camera, a recording or a simulated world"),
    "demo": ("prism_edge.cli.demo", "see metric poses arrive: a simulated walk through the whole daemon"),
    "watch": ("prism_edge.cli.watch", "show the poses of a running daemon, or record them"),
    "ctl": ("prism_edge.cli.ctl", "tell a running daemon to do something: pause, reset, save a map, ..."),
    "eval": ("prism_edge.cli.eval", "run a recorded sequence and score the poses against its truth"),
    "calibrate": ("prism_edge.cli.calibrate", "make a camera file from views of a calibration board"),
    "mask": ("prism_edge.cli.mask", "find what of the images is the robot itself, and write a mask"),
    "map": ("prism_edge.cli.map", "describe a saved map, or export its path and points in metres"),
    "reconstruct": ("prism_edge.cli.reconstruct", "make a dense coloured cloud of a finished map"),
    "models": ("prism_edge.cli.models", "list, describe, pull, verify, time and remove depth networks"),
    "doctor": ("prism_edge.cli.doctor", "check that this machine has what the daemon needs"),
    "config": ("prism_edge.cli.config", "print the effective configuration, or check a file"),
    "worker": ("prism_edge.cli.worker", "run one of the five processes alone"),
}

EXIT_CODES = """exit codes:
  0    done
  1    `doctor` found something that does not work, or `ctl` was refused
  2    the command line is wrong
  3    a configuration, camera or mask file, or a setting, is wrong; or the file to write can't be
  4    a camera, video or recording can't be opened or read
  5    a depth model can't be loaded or breaks its contract
  6    the Zenoh endpoint is in use, not reachable or not valid
  7    a process kept dying and was given up
  8    a run can't be scored, or broke a rule of the evaluation
  9    views of a board don't give a camera's intrinsics, or a camera hardly moved while a mask was made
  10   a stored map can't be read, written or used
  70   an error of prism_edge itself
  74   a file can't be read or written amid the work: a full disk, mostly
  130  ended by Ctrl-C before it could end in order
"""


class Parser(argparse.ArgumentParser):
    """One that takes options by their whole names alone: `--mode` is not `--model`."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**{"allow_abbrev": False, **options})


def build_parser(chosen: str | None) -> argparse.ArgumentParser:
    """The parser, complete only for the subcommand ``chosen``; the others are there by name and help."""
    parser = Parser(
        prog="prism-edge",
        description="One RGB camera in, metric camera poses out, over Eclipse Zenoh.",
        epilog=EXIT_CODES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"prism-edge {__version__}")
    subparsers = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for name, (module, help_line) in COMMANDS.items():
        if name == chosen:
            importlib.import_module(module).add_parser(subparsers, help_line)
        else:
            subparsers.add_parser(name, help=help_line, add_help=False)
    return parser


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    open_closed()
    print_anything()
    given = sys.argv[1:] if arguments is None else arguments
    chosen = next((word for word in given if not word.startswith("-")), None)
    try:
        args = build_parser(chosen).parse_args(given)
        code: int = importlib.import_module(COMMANDS[args.command][0]).run(args)
        sys.stdout.flush()
        return code
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:
        drop_output()  # its reader has gone (`| head`)
        return 0
    except SystemExit as ended:
        if isinstance(ended.__context__, BrokenPipeError):  # of which rich makes an exit with 1
            return 0
        raise
    except Exception as error:
        if isinstance(error, ImportError) and _is_of_ctrl_c(error):
            return 130
        code = report(error)
    try:
        sys.stdout.flush()
    except OSError:
        drop_output()
    return code


def _is_of_ctrl_c(error: BaseException | None) -> bool:
    """Whether an interrupt is behind it: amid an import a library written in C makes an error of that."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None


def script() -> int:
    """As :func:`main`, of a process that ends with it."""
    if sys.argv[1:2] in (["run"], ["worker"]):  # what stays, and works through every image
        begin_with_huge_pages()
    return ended(main())


if __name__ == "__main__":
    sys.exit(script())
