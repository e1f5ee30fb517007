"""`prism-edge models`: which depth networks are known, and what to do with one."""

from __future__ import annotations

import argparse
import importlib
from typing import Any

from prism_edge.cli.settings import a_path, seconds_above_zero, whole_from_one_to

DESCRIPTION = (
    "Depth networks. A network is named to `run` and `eval` by its file, by its name once its file is at "
    "hand, or as nested:RELATIVE,METRIC. docs/MODELS.md says how a file of your own describes itself."
)
_SHOW = "prism_edge.cli.models_show"
_FILES = "prism_edge.cli.models_files"


def add_parser(subparsers: Any, help_line: str) -> None:
    """Add the subcommand, with its line of `prism-edge --help`."""
    parser: argparse.ArgumentParser = subparsers.add_parser("models", help=help_line, description=DESCRIPTION)
    actions = parser.add_subparsers(dest="action", metavar="ACTION", required=True)

    def action(name: str, module: str, help: str) -> argparse.ArgumentParser:
        made: argparse.ArgumentParser = actions.add_parser(name, help=help, description=help)
        made.set_defaults(module=module, action=name)
        return made

    action("list", _SHOW, "every known network, its licence, and whether it is at hand")
    info = action("info", _SHOW, "one network's card; a file is loaded and checked against it")
    info.add_argument("model", metavar="NAME_OR_PATH", help="registered name, ONNX file or nested:...")
    _add_pull(action("pull", _FILES, "download a registered network, or an ONNX file from anywhere"))
    verify = action("verify", _FILES, "hold files to their digests, load them and run them once")
    verify.add_argument(
        "models", metavar="NAME_OR_PATH", nargs="*", help="nested:... too; default: all that are at hand"
    )
    remove = action("remove", _FILES, "delete what `pull` brought")
    remove.add_argument("name", metavar="NAME")
    remove.add_argument("--yes", action="store_true", help="don't ask")
    _add_bench(action("bench", "prism_edge.cli.models_bench", "latency and memory on this machine"))


def _add_pull(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("model", metavar="NAME_OR_URL", help="registered name, or URL of an ONNX file")
    parser.add_argument("--accept-licence", action="store_true", help="agree to a non-commercial licence")
    parser.add_argument(
        "--unverified", action="store_true", help="take files whose SHA-256 is not known, and remember it"
    )
    parser.add_argument("--sha256", default="", metavar="HEX", help="of the file behind a URL")
    parser.add_argument("--name", default="", help="for a URL's file (default: the file's own)")
    parser.add_argument(
        "--into", metavar="FOLDER", type=a_path, help="where to keep it (default: see docs/MODELS.md)"
    )
    parser.add_argument(
        "--stall", type=_stall_s, default=30.0, metavar="S", help="seconds without data before trying again"
    )


def _add_bench(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("model", metavar="NAME_OR_PATH", help="registered name, ONNX file or nested:...")
    parser.add_argument(
        "--threads",
        type=whole_from_one_to(64),
        nargs="+",
        metavar="N",
        help="thread counts (default: 1, 2, 4 ... all cores)",
    )
    parser.add_argument(
        "--providers", nargs="+", metavar="NAME", help="execution providers (default: all that are here)"
    )
    parser.add_argument("--config", metavar="FILE", help="take what else depth.* says from this file")
    parser.add_argument(
        "--runs", type=whole_from_one_to(10_000), default=30, metavar="N", help="inferences each (default 30)"
    )


def _stall_s(text: str) -> float:
    seconds = seconds_above_zero(text)
    if not 0.1 <= seconds <= 3600.0:
        raise argparse.ArgumentTypeError(f"expected 0.1 to 3600 seconds, got {text!r}")
    return seconds


def run(args: argparse.Namespace) -> int:
    """Do what was asked; returns the exit code. Raises ModelError for a network that can't be used."""
    code: int = importlib.import_module(args.module).run(args)
    return code
