"""The worker's benchmark with a tiny network: a real process, turns, and figures that hang together."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.synthetic.network import TinyNetwork, write_tiny_network
from tools import benchmark_worker


def test_worker_and_bare_session_take_turns(tmp_path: Path, capfd):
    # a relative one, which the worker takes only as if it had metres
    path = write_tiny_network(tmp_path / "tiny.onnx", TinyNetwork(depth_kind="relative"))
    assert benchmark_worker.main([str(path), "--runs", "4", "--rest", "0.5"]) == 0
    out = capfd.readouterr().out
    assert "tiny_tint on CPUExecutionProvider" in out
    figures = re.findall(r"^(.+?) +([\d.]+) ms( +[\d.]+ x bare)?$", out, re.MULTILINE)
    assert [name for name, _, _ in figures] == [
        "bare onnxruntime",
        "worker, its own time",
        "picture sent to depth",
        "CPU time: bare",
        "CPU time: worker",
    ]
    assert all(float(ms) > 0 for _, ms, _ in figures[:4])  # the last is counted in ticks of 10 ms
    assert re.search(r"CPU at rest: [\d.]+ % of a core", out)
    assert re.search(r"between keyframes: [\d.]+ % of a core", out)


def test_a_turns_ratio_is_within_the_turn(capsys):
    slow = benchmark_worker.Turn(100.0, 110.0, 120.0, 90.0, 100.0)
    fast = benchmark_worker.Turn(10.0, 11.0, 12.0, 9.0, 0.0)
    benchmark_worker.show_turns([slow, fast, slow])
    out = capsys.readouterr().out
    assert "1.058 x bare" in out  # of CPU time: 200 ms by 189 ms
    assert "100.00 ms" in out
    assert "1.100 x bare" in out
    assert "1.200 x bare" in out


def test_what_is_no_network_is_one_line(tmp_path: Path, capsys):
    (tmp_path / "net.onnx").write_bytes(b"none")
    assert benchmark_worker.main([str(tmp_path / "net.onnx")]) == 5
    assert capsys.readouterr().err.count("\n") == 1


def test_a_rest_that_is_none_is_refused_before_anything_is_measured(capsys):
    with pytest.raises(SystemExit):
        benchmark_worker.main(["prism_nano", "--rest=-1"])
    assert "--rest" in capsys.readouterr().err
