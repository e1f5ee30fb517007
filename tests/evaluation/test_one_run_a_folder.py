"""A folder of results is one run's at a time."""

from __future__ import annotations

from pathlib import Path

import pytest

from prism_edge.errors import EvaluationError
from prism_edge.evaluation.results import alone_in


def test_another_run_is_refused_until_the_first_has_ended(tmp_path: Path) -> None:
    out = tmp_path / "run"
    with alone_in(out):
        with pytest.raises(EvaluationError, match="another run"), alone_in(out):
            pass
        with pytest.raises(EvaluationError, match="another run"), alone_in(out):  # that took nothing away
            pass
        with alone_in(tmp_path / "other"):
            pass
    with alone_in(out):
        pass
