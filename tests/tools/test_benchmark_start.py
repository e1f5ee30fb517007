"""The benchmark of the start measures a start, both ways, and says what a wrong call lacks."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

CHECKOUT = Path(__file__).resolve().parents[2]
NUMBER = r"(\d+\.\d\d)"


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "tools/benchmark_start.py", *arguments]
    return subprocess.run(command, cwd=CHECKOUT, capture_output=True, text=True, timeout=120)


def test_both_ways_are_measured() -> None:
    done = run("--rounds", "1")
    assert done.returncode == 0, done.stderr
    for figure in ("ready s", "CPU s", "memory MB"):
        row = re.search(rf"\| {figure} \| {NUMBER} .*\| {NUMBER} .*\| {NUMBER} \|", done.stdout)
        assert row is not None, done.stdout
        forks, programs, ratio = map(float, row.groups())
        assert forks > 0.0
        assert ratio == pytest.approx(forks / programs, abs=0.03)


@pytest.mark.parametrize("arguments", [["sim:room"], ["--rounds", "0"]])
def test_a_wrong_call_is_refused(arguments: list[str]) -> None:
    assert run(*arguments).returncode == 2


def test_a_daemon_that_does_not_start_says_why() -> None:
    done = run("--rounds", "1", "/no/such/recording", "prism_nano")
    assert done.returncode != 0
    assert "/no/such/recording" in done.stderr
