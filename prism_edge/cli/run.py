"""`prism-edge run`: the daemon in the foreground."""

from __future__ import annotations

import argparse
import logging
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import prism_edge.workers  # noqa: F401 - before NumPy, whose threads would keep workers from being forks
from prism_edge.cli.settings import add_common, add_input, config_from
from prism_edge.config import Config
from prism_edge.errors import ConfigError


def add_parser(subparsers: Any, help_line: str) -> None:
    """Add the subcommand, with its line of `prism-edge --help`."""
    parser: argparse.ArgumentParser = subparsers.add_parser(
        "run",
        help=help_line,
        description="Start the five processes on SOURCE and publish poses on Zenoh below prism/<robot>/ "
        "until the recording ends, or until Ctrl-C or SIGTERM. Without a network there are no poses, as "
        "depth begins the map. SIGHUP reads --config again and takes up what can change, but under a "
        "terminal it ends the run (docs/OPERATIONS.md).",
    )
    add_input(parser)
    add_common(parser)
    parser.add_argument(
        "--stay", action="store_true", help="go on answering subscribers when the recording has ended"
    )


def run(args: argparse.Namespace) -> int:
    """Check what the user gave, then run; returns the exit code."""
    config = config_from(args)
    check(config)

    from prism_edge.supervisor.supervise import supervise
    from prism_edge.workers.launch import log_as_configured

    log_as_configured("supervisor", config)
    return supervise(config, stay=args.stay, reread=lambda: config_from(args))


def check(config: Config) -> None:
    """Raise the PrismError that a process would end in, before any is started."""
    from prism_edge.bus.access import check_network
    from prism_edge.bus.keys import check_loopback, check_robot_name
    from prism_edge.sources.live.open import check_mode
    from prism_edge.sources.open import AUTO, AUTO_NEEDS, open_source

    check_robot_name(config.robot)
    check_loopback(config.bus.endpoint)
    check_network(config.network, config.bus.endpoint)
    check_mode(config)
    with _unsaid("prism_edge.sources"):
        open_source(config.source)
    if config.source.camera == AUTO and not config.depth.network:
        raise ConfigError(AUTO_NEEDS)


@contextmanager
def _unsaid(logger: str) -> Iterator[None]:
    """Without the logger's warnings, which the source's process is going to give."""
    log = logging.getLogger(logger)
    level = log.level
    log.setLevel(logging.ERROR)
    try:
        yield
    finally:
        log.setLevel(level)
