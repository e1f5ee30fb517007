"""What `prism-edge eval` would note of a run, without one."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any

from prism_edge.cli.eval import effective
from prism_edge.cli.main import build_parser
from prism_edge.evaluation.metrics import versions


def metrics_of(words: Sequence[str]) -> dict[str, Any]:
    """Settings, versions and truth as metrics.json has them, on a free endpoint as `eval` takes one."""
    args = build_parser("eval").parse_args(list(words))
    config = effective(args)
    config = replace(config, bus=replace(config.bus, endpoint="tcp/127.0.0.1:40001"))
    config = replace(config, source=replace(config.source, wait_s=1.0))
    return {
        "config": json.loads(json.dumps(asdict(config))),
        "versions": versions(),
        "truth": str(args.truth) if args.truth else "the sequence's own",
        "violations": [],
        "live": {},
    }
