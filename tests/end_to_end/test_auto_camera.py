"""The whole daemon on a camera that nobody calibrated."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

from onnx import TensorProto, helper

from tests.end_to_end.conftest import FRAMES, HEIGHT, WIDTH
from tests.end_to_end.processes import prism_edge
from tests.synthetic.network import TinyNetwork, save, tiny_graph
from tests.synthetic.sequence import synthetic_camera


def test_metric_poses_come_without_any_camera_file(room: Path, tmp_path: Path) -> None:
    what = TinyNetwork(width=WIDTH, height=HEIGHT)
    camera = synthetic_camera(WIDTH, HEIGHT)
    matrix = [camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0]
    graph = tiny_graph(what)
    value = helper.make_tensor("matrix", TensorProto.FLOAT, [1, 3, 3], matrix)
    graph.node.append(helper.make_node("Constant", [], ["camera"], value=value))
    graph.output.append(helper.make_tensor_value_info("camera", TensorProto.FLOAT, [1, 3, 3]))
    save(tmp_path / "net.onnx", graph, replace(what.card(), intrinsics_output="camera"))
    (tmp_path / "room").mkdir()
    for name in ("rgb", "rgb.txt", "groundtruth.txt"):  # all but the camera
        (tmp_path / "room" / name).symlink_to(room / name)
    out = tmp_path / "out"
    arguments = ("--camera", "auto", "--model", tmp_path / "net.onnx", "--out", out, "--lockstep")
    done = prism_edge("eval", tmp_path / "room", *arguments)
    assert done.returncode == 0, done.stderr
    report = json.loads((out / "metrics.json").read_text())
    assert report["tracked"] >= FRAMES - 5
    assert report["final"]["ate_se3_m"] < 0.03
    assert "as tiny_tint sees it" in (out / "daemon.log").read_text()
    assert report["camera"]["origin"].startswith("auto: as tiny_tint sees it in 5 images: f ")
    assert report["camera"]["fx"] is None


def test_run_says_that_auto_needs_a_network(room: Path) -> None:
    done = prism_edge("run", room, "--camera", "auto")
    assert done.returncode != 0
    assert "needs a depth network" in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
