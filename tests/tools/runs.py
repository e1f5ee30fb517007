"""What `prism-edge eval` would note of a run, without one; and a path that it might have published."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from prism_edge.cli.eval import effective
from prism_edge.cli.main import build_parser
from prism_edge.errors import PrismError
from prism_edge.evaluation import run
from prism_edge.evaluation.files import digests_of, files_of
from prism_edge.evaluation.metrics import versions
from prism_edge.evaluation.played import Played, played
from prism_edge.evaluation.trajectory import Trajectory
from prism_edge.sources import open_source
from prism_edge.sources.truth import read_truth


def metrics_of(words: Sequence[str]) -> dict[str, Any]:
    """Settings, versions, camera and truth as metrics.json has them, with whatever `eval` sets by itself."""
    args = build_parser("eval").parse_args(list(words))
    config = run.as_it_runs(run.on_free_endpoint(effective(args)))
    made_of, own = Played(), None
    with contextlib.suppress(PrismError):
        made_of = played(config.source, open_source(config.source), args.truth)
        own = "the sequence's own" if read_truth(config.source.uri) else None
    known = made_of.truth_file
    return {
        "camera": json.loads(json.dumps(made_of.camera)),
        "images": made_of.images,
        "files": digests_of(files_of(config, args.truth or (Path(known) if known else None))),
        "truth_file": made_of.truth_file if args.truth or own else None,
        "config": json.loads(json.dumps(asdict(config))),
        "versions": versions(),
        "truth": str(args.truth) if args.truth else own,
        "violations": [],
        "live": {},
    }


def on_a_spiral(count: int) -> Trajectory:
    """Poses in metres, ten a second."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    turn = np.linspace(0, 6, count)
    poses[:, :3, 3] = np.stack([np.cos(turn), np.sin(turn), 0.3 * turn], axis=1)
    return Trajectory(np.arange(count, dtype=np.int64) * 100_000_000, poses)
