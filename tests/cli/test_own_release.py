"""A daemon and the release that it was started from."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from prism_edge.cli.own_release import go_to_own_release

CHECKOUT = Path(__file__).resolve().parents[2]
ASK = "import sys; from prism_edge.cli.own_release import go_to_own_release as go; go(['-c', {then!r}])"


def test_through_a_link_it_becomes_what_that_leads_to(tmp_path: Path) -> None:
    if sys.prefix == sys.base_prefix:
        pytest.skip("these tests run in no virtual environment")
    (tmp_path / "current").symlink_to(sys.prefix)
    python = tmp_path / "current" / Path(sys.executable).relative_to(sys.prefix)
    then = "import os, sys; print(os.getpid(), sys.prefix, sys.executable)"
    process = subprocess.Popen(
        [python, "-c", ASK.format(then=then)],
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": str(CHECKOUT)},
    )
    said = process.communicate(timeout=60)[0].split()
    real = os.path.realpath(sys.prefix)
    assert said[:2] == [str(process.pid), real]
    assert said[2].startswith(real)


def test_without_a_link_nothing_begins_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    begun: list[str] = []
    monkeypatch.setattr(os, "execv", lambda path, words: begun.append(path))
    monkeypatch.setattr(sys, "prefix", os.path.realpath(sys.prefix))
    monkeypatch.setattr(sys, "executable", f"{sys.prefix}/bin/python")
    go_to_own_release(["-m", "prism_edge.cli", "run"])
    monkeypatch.setattr(sys, "executable", "/elsewhere/python")
    go_to_own_release(["-m", "prism_edge.cli", "run"])
    assert begun == []
