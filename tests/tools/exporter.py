"""Runs the export tool in its own environment, where there is one."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest

CHECKOUT = Path(__file__).resolve().parents[2]


def exporter_python() -> Path:
    """The export environment's Python; skips where there is none."""
    named = os.environ.get("PRISM_EDGE_EXPORT_PYTHON", "")
    python = Path(named) if named else CHECKOUT / ".venv-export" / "bin" / "python"
    if not python.is_file():
        pytest.skip("no export environment: tools/export_da3/setup.sh makes it (.venv-export)")
    return python


def run(*arguments: object) -> str:
    """What Python with these arguments says on stdout; fails the test, with stderr, where it fails."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    command = [str(part) for part in (exporter_python(), *arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=900, env=environment, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


def export(*arguments: object) -> dict[str, dict[str, float]]:
    """Exports; the largest printed error of each output, by file name."""
    errors: dict[str, dict[str, float]] = {}
    for line in run(CHECKOUT / "tools" / "export_da3", *arguments).splitlines():
        words = line.split()
        if "relative error" in line:
            errors[words[0].rstrip(":")] = {}
        elif len(words) == 5 and words[1] == "largest":
            errors[list(errors)[-1]][words[0]] = float(words[2])
    return errors
