"""Runs drawn at random: the same from the same number, all of them playable, and told as they came out."""

from __future__ import annotations

import subprocess

import pytest

from prism_edge.sources.sim import SimSource
from tools import random_runs
from tools.random_runs import Draw, command, drawn, line, main, summary


def test_a_seed_has_the_same_runs_however_many_are_asked_for():
    assert drawn(5, 3) == drawn(5, 12)[:3]
    assert drawn(5, 12) != drawn(6, 12)
    many = drawn(1, 200)
    assert {draw.kind for draw in many} == {"room", "loop", "street"}
    assert {draw.depth for draw in many} == {"network", "prism_nano", "sensor"}


@pytest.mark.parametrize("draw", drawn(3, 40), ids=lambda draw: draw.uri)
def test_every_address_is_one_that_the_simulator_takes(draw: Draw):
    source = SimSource(draw.uri)
    assert source.frame_count >= 200


def metrics(live_m: float, nees: float) -> dict[str, object]:
    errors = {"live": {"ate_sim3_m": live_m}, "final": {"ate_sim3_m": live_m / 2}}
    return {**errors, "coverage": 0.99, "nees_1s": nees, "nees_pose": 2 * nees, "scale_sigma_to_bias": 1.25}


def test_rows_and_averages():
    room, exact, street = (Draw(n, f"sim:{kind}?seed=1", depth) for n, (kind, depth) in enumerate(
        (("room", "network"), ("loop", "sensor"), ("street", "network"))
    ))
    row = "| 0 | `sim:room?seed=1` | network | 0.990 | 4.0 | 2.0 | 3.00 |  | 1.25 |"
    assert line(room, metrics(0.04, 3.0)) == row
    assert "failed" in line(room, None)
    told = summary([
        (room, metrics(0.04, 4.0)), (room, metrics(0.01, 0.25)), (exact, metrics(0.01, 1.0)),
        (street, metrics(5.0, 200.0)), (room, None),
    ])
    assert len(told) == 2
    assert "2 runs" in told[0]
    assert "live 2.0, final 1.0 cm" in told[0]
    assert "mean 2.12, geometric 1.00, above 2 1, below 0.5 1; of poses geometric 2.00" in told[0]


def test_runs_without_a_score_are_told_and_counted():
    room = Draw(0, "sim:room?seed=1", "network")
    nothing = metrics(0.04, 1.0) | {"live": {"ate_sim3_m": None}, "final": {"ate_sim3_m": None}}
    assert "| 0.990 | - | - |" in line(room, nothing)
    (told,) = summary([(room, nothing), (room, metrics(0.04, 1.0))])
    assert "live 4.0 (1 without), final 2.0 (1 without) cm" in told
    (told,) = summary([(room, nothing)])
    assert "live - (1 without)" in told


def test_a_run_that_fails_is_named_and_costs_the_exit_code(tmp_path, monkeypatch, capsys):
    given: list[list[str]] = []

    def fail(words, **settings):
        given.append(words)
        return subprocess.CompletedProcess(words, 5, "", "a line\nprism-edge: error: no such network\n")

    monkeypatch.setattr(random_runs.subprocess, "run", fail)
    assert main(["--network", "nope", "--seed", "2", "--count", "1", "--out", str(tmp_path)]) == 1
    (draw,) = drawn(2, 1)
    assert given[0][3:] == command(draw, "nope", tmp_path / "2")
    said = capsys.readouterr()
    assert "no such network" in said.err
    assert "failed" in said.out
