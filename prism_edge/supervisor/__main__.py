"""``python -m prism_edge.supervisor --config FILE``: the daemon with a complete configuration file."""

from __future__ import annotations

import argparse
import sys

from prism_edge.bus.leaving import ended
from prism_edge.config_file import load
from prism_edge.errors import report
from prism_edge.supervisor.supervise import supervise
from prism_edge.workers.launch import log_as_configured, log_to_stderr


def main(arguments: list[str] | None = None) -> int:
    """Run until told to stop; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m prism_edge.supervisor", description=__doc__)
    parser.add_argument("--config", metavar="FILE", required=True, help="the configuration (YAML)")
    args = parser.parse_args(arguments)
    log_to_stderr("supervisor")
    try:
        config = load(args.config)
        log_as_configured("supervisor", config)
        return supervise(config, reread=lambda: load(args.config))
    except Exception as error:  # whose last line whoever started us passes on
        return report(error)


if __name__ == "__main__":
    sys.exit(ended(main()))
