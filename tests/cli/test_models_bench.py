"""`prism-edge models bench`: which settings are timed, what a row holds, and what one that fails costs."""

from __future__ import annotations

import json
import signal
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import onnxruntime
import pytest

from prism_edge import depth
from prism_edge.cli import models_bench
from prism_edge.cli.main import main
from prism_edge.config import DepthConfig
from prism_edge.errors import ModelError
from tests.synthetic.network import TinyNetwork, write_tiny_network

COST = models_bench.Cost("CPUExecutionProvider", 1.0, 2.0, 3.0, 4.0, 5.0)


@pytest.fixture(autouse=True)
def plain(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A wide terminal, and no network files but those of the test."""
    monkeypatch.setenv("COLUMNS", "400")
    monkeypatch.setenv("PRISM_EDGE_MODELS", str(tmp_path / "models"))


def said(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    assert main(["models", *arguments]) == 0
    return capsys.readouterr().out


def rows(out: str) -> list[list[str]]:
    return [[cell.strip() for cell in line.split("│")[1:-1]] for line in out.splitlines() if line[:1] == "│"]


def test_bench_shows_a_row_for_each_setting(tmp_path: Path, capsys):
    path = write_tiny_network(tmp_path / "tiny.onnx", TinyNetwork(depth_kind="relative"))
    out = said(capsys, "bench", str(path), "--threads", "1", "2", "--runs", "3", "--providers", "cpu")
    assert [row[:2] for row in rows(out)] == [["CPU", "1"], ["CPU", "2"]]
    for row in rows(out):
        median, p90, cpu, load, memory = (float(cell) for cell in row[2:])
        assert 0 < median <= p90
        assert cpu > 0
        assert load > 0
        assert 0 < memory < 1000


def test_bench_goes_on_without_a_provider_that_is_not_there(capsys, monkeypatch):
    monkeypatch.setattr(models_bench, "measure", lambda config, runs: COST)
    out = said(capsys, "bench", "x.onnx", "--threads", "1", "--providers", "qnn", "cpu")
    assert [row[0] for row in rows(out)] == ["CPU"]
    assert out.count("this onnxruntime has no ") == out.count("has no qnn provider (it has ") == 1
    assert "depth.required" not in out
    assert main(["models", "bench", "x.onnx", "--providers", "qnn"]) == 5
    assert "error: this onnxruntime has no qnn provider (it has " in capsys.readouterr().err


def test_bench_takes_the_rest_from_a_configuration(tmp_path: Path, capsys, monkeypatch):
    asked = []

    def measured(config: DepthConfig, runs: int) -> models_bench.Cost:
        asked.append(config)
        return COST

    monkeypatch.setattr(models_bench, "measure", measured)
    (tmp_path / "robot.yaml").write_text("depth: {arena: false, model: other, threads: 7}\n")
    said(capsys, "bench", "x.onnx", "--threads", "2", "--config", str(tmp_path / "robot.yaml"))
    assert asked == [DepthConfig("x.onnx", ("cpu",), required=("cpu",), threads=2, arena=False)]
    assert main(["models", "bench", "x.onnx", "--config", str(tmp_path / "none.yaml")]) == 3


def test_a_child_that_dies_is_one_line(monkeypatch):
    monkeypatch.setattr(models_bench, "_child", _die)
    with pytest.raises(ModelError, match="the process died"):
        models_bench.measure(DepthConfig("x"), 1)


def _die(pipe: object, config: object, runs: int) -> None:
    raise SystemExit(9)


def test_ctrl_c_is_left_to_the_one_who_ends_the_child(monkeypatch):
    before = signal.getsignal(signal.SIGINT)
    monkeypatch.setattr(models_bench, "_child", _tell_of_ctrl_c)
    with pytest.raises(ModelError, match=f"^it is {int(signal.SIG_IGN)}$"):
        models_bench.measure(DepthConfig("x"), 1)
    assert signal.getsignal(signal.SIGINT) == before


def _tell_of_ctrl_c(pipe: Any, config: object, runs: int) -> None:
    pipe.send_bytes(json.dumps(f"it is {int(signal.getsignal(signal.SIGINT))}").encode())


def test_bench_takes_all_cores_and_all_providers_that_it_knows(capsys, monkeypatch):
    monkeypatch.setattr(models_bench, "_cores", lambda: 6)
    offered = ["CUDAExecutionProvider", "AzureExecutionProvider", "CPUExecutionProvider"]
    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: offered)
    asked = []
    monkeypatch.setattr(models_bench, "measure", lambda config, runs: asked.append(config) or COST)
    said(capsys, "bench", "x.onnx")
    wanted = [(provider, threads) for provider in ("cuda", "cpu") for threads in (1, 2, 4, 6)]
    assert [(config.providers[0], config.threads) for config in asked] == wanted
    assert models_bench._powers(1) == [1]
    assert models_bench._powers(100) == [1, 2, 4, 8, 16, 32, 64]  # more than 64 are refused


def test_a_setting_that_fails_costs_no_other_and_is_said_once(capsys, monkeypatch):
    def measured(config: DepthConfig, runs: int) -> models_bench.Cost:
        if config.threads > 1:
            raise ModelError("too much for it")
        return COST

    monkeypatch.setattr(models_bench, "measure", measured)
    out = said(capsys, "bench", "x.onnx", "--threads", "2", "1", "4", "--providers", "cpu")
    assert [row[1] for row in rows(out)] == ["1"]
    assert out.count("too much for it") == 1


def test_a_pair_is_timed_as_one(tmp_path: Path, capsys):
    relative = write_tiny_network(tmp_path / "r.onnx", TinyNetwork(name="r", depth_kind="relative"))
    metric = write_tiny_network(tmp_path / "m.onnx", TinyNetwork(name="m"))
    one = ("--threads", "1", "--runs", "1", "--providers", "cpu")
    assert len(rows(said(capsys, "bench", f"nested:{relative},{metric}", *one))) == 1


def test_a_cost_is_of_one_inference(monkeypatch):
    clock = {"wall": 0.0, "cpu": 0.0}
    taken_ms = iter([1.0] * 8 + [2.0] * 2)

    def infer(*_: Any) -> None:
        clock["wall"] += 1e-3 * next(taken_ms)
        clock["cpu"] += 3e-3

    def opened(*_: Any) -> Any:
        clock["wall"] += 0.5
        return SimpleNamespace(infer=infer, provider="CPUExecutionProvider")

    monkeypatch.setattr(cv2, "setNumThreads", lambda count: None)  # else of every test after this one
    monkeypatch.setattr(depth, "open_onnx", opened)
    monkeypatch.setattr(models_bench.time, "perf_counter", lambda: clock["wall"])
    monkeypatch.setattr(models_bench.time, "process_time", lambda: clock["cpu"])
    cost = models_bench._cost(DepthConfig("x"), 10)
    figures = (cost.load_s, cost.median_ms, cost.p90_ms, cost.cpu_ms)
    assert figures == pytest.approx((0.5, 1.0, 2.0, 3.0))


def test_a_child_that_hangs_is_ended(monkeypatch):
    monkeypatch.setattr(models_bench, "_PATIENCE_S", 0.1)
    monkeypatch.setattr(models_bench, "_child", _hang)
    with pytest.raises(ModelError, match=r"has not ended in 0\.1 s"):
        models_bench.measure(DepthConfig("x"), 1)


def _hang(pipe: Any, config: object, runs: int) -> None:
    pipe.recv()
