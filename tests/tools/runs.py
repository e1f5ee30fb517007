"""What `prism-edge eval` would note of a run, without one."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from prism_edge.cli.eval import effective
from prism_edge.cli.main import build_parser
from prism_edge.evaluation import run
from prism_edge.evaluation.metrics import versions


def metrics_of(words: Sequence[str]) -> dict[str, Any]:
    """Settings, versions and truth as metrics.json has them, with whatever `eval` sets by itself."""
    args = build_parser("eval").parse_args(list(words))
    with TemporaryDirectory() as out:
        config = run._prepared(run.on_free_endpoint(effective(args)), Path(out))
    return {
        "config": json.loads(json.dumps(asdict(config))),
        "versions": versions(),
        "truth": str(args.truth) if args.truth else "the sequence's own",
        "violations": [],
        "live": {},
    }
