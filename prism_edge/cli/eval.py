"""`prism-edge eval`: a recorded sequence through the very same daemon, and what a subscriber got, scored."""

from __future__ import annotations

import argparse
import contextlib
import signal
from collections.abc import Iterator
from dataclasses import replace
from types import FrameType
from typing import Any

from prism_edge.cli.settings import (
    FREE_PORT,
    RECORDING_HELP,
    a_path,
    add_common,
    add_playing,
    config_from,
    endpoint_given,
    find_networks,
    whole_above_zero,
)
from prism_edge.config import ABLATIONS, Config
from prism_edge.errors import ConfigError


def add_parser(subparsers: Any, help_line: str) -> None:
    """Add the subcommand, with its line of `prism-edge --help`."""
    parser: argparse.ArgumentParser = subparsers.add_parser(
        "eval",
        help=help_line,
        description="Play SEQUENCE through the daemon, listen as an ordinary subscriber, and write live.tum "
        "(poses as published), final.tum (after the last optimisation), truth.tum and metrics.json to the "
        "folder DIR (docs/EVALUATION.md). Ground truth is for scores only. Unless --endpoint is "
        "given, a free loopback port is taken, so that several evaluations can run side by side.",
    )
    parser.add_argument("source", metavar="SEQUENCE", help=RECORDING_HELP)
    parser.add_argument(
        "--out", metavar="DIR", type=a_path, required=True, help="where results go (created; overwritten)"
    )
    add_playing(parser)
    parser.add_argument(
        "--frames",
        metavar="N",
        type=whole_above_zero,
        help="play the first N frames of the recording alone (default: all)",
    )
    parser.add_argument(
        "--ablate",
        metavar="PART",
        action="append",
        default=[],
        help=f"switch a part off ({', '.join(ABLATIONS)}); may be repeated",
    )
    parser.add_argument(
        "--truth",
        metavar="FILE.tum",
        type=a_path,
        help="score against this trajectory, not the sequence's own",
    )
    add_common(parser, FREE_PORT)


def run(args: argparse.Namespace) -> int:
    """Evaluate and print a table; returns the exit code. Raises PrismError."""
    config = effective(args)
    find_networks(config)  # before an earlier run's results give way to this one's

    from prism_edge.evaluation.run import evaluate
    from prism_edge.evaluation.table import show

    with ended_in_order():
        report = evaluate(config, args.out, args.truth, keep_endpoint=endpoint_given(args))
        show(report, args.out)
    return 0


def effective(args: argparse.Namespace) -> Config:
    """The configuration that these options ask for. Raises ConfigError."""
    check_ablations(args.ablate)
    if args.frames:
        args.set.append(f"source.frames={args.frames}")
    config = config_from(args)
    return replace(config, ablate=tuple(dict.fromkeys((*config.ablate, *args.ablate))))


def check_ablations(names: list[str]) -> None:
    """Raises ConfigError, saying why, for a part that can't be switched off."""
    for name in names:
        if name in ABLATIONS:
            continue
        raise ConfigError(f"--ablate {name}: no such part; use one of {', '.join(ABLATIONS)}")


@contextlib.contextmanager
def ended_in_order() -> Iterator[None]:
    """SIGTERM, and SIGHUP (a terminal went away; not under nohup), end the daemon and keep the poses."""
    ends = [n for n in (signal.SIGTERM, signal.SIGHUP) if signal.getsignal(n) is not signal.SIG_IGN]
    before = {number: signal.signal(number, _terminated) for number in ends}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _terminated(number: int, frame: FrameType | None) -> None:
    """Leave through the blocks that end the daemon; another signal, which often follows, breaks none off."""
    for each in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(each, signal.SIG_IGN)
    raise SystemExit(128 + number)
