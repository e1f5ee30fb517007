"""A camera that nobody calibrated: what the network says of it, and who is told when it says nothing."""

from __future__ import annotations

import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from onnx import TensorProto, helper

from prism_edge.config import Config, DepthConfig, FramesConfig, SourceConfig
from prism_edge.errors import ConfigError, SourceError
from prism_edge.geometry.mount import looking
from prism_edge.sources import open_source
from prism_edge.sources.checks import UNCALIBRATED
from prism_edge.workers import uncalibrated
from prism_edge.workers.source import main
from prism_edge.workers.uncalibrated import estimated_camera, median_camera
from tests.synthetic.network import TinyNetwork, save, tiny_graph, write_tiny_network
from tests.waiting import until
from tests.workers.source_bench import running

MATRIX = [60.0, 0.0, 159.5, 0.0, 80.0, 119.5, 0.0, 0.0, 1.0]  # at the network's 320 x 240


def network(path: Path, matrix: list[float] = MATRIX) -> Path:
    """A network whose intrinsics are always the same."""
    what = TinyNetwork()
    graph = tiny_graph(what)
    value = helper.make_tensor("matrix", TensorProto.FLOAT, [1, 3, 3], matrix)
    graph.node.append(helper.make_node("Constant", [], ["camera"], value=value))
    graph.output.append(helper.make_tensor_value_info("camera", TensorProto.FLOAT, [1, 3, 3]))
    save(path, graph, replace(what.card(), intrinsics_output="camera"))
    return path


def config(source: Path, model: str) -> Config:
    return Config(source=SourceConfig(uri=str(source), camera="auto"), depth=DepthConfig(model=model))


def test_the_camera_is_the_networks_in_pixels_of_the_image(tiny_sequence: Path, tmp_path: Path):
    path = network(tmp_path / "net.onnx")
    said, camera = estimated_camera(config(tiny_sequence, str(path)), threading.Event())
    # 64 x 48 images become 320 x 240: five times as large
    assert (camera.width, camera.height, camera.distortion) == (64, 48, ())
    assert [camera.fx, camera.fy, camera.cx, camera.cy] == pytest.approx([12, 16, 31.5, 23.5])
    assert "4 images" in said  # of 24 at 30 Hz, 0.2 s apart


def test_a_camera_on_its_side_is_judged_by_upright_pictures(tiny_sequence: Path, tmp_path: Path):
    """48 x 64 after a turn becomes 320 x 240; what was across there is down in the camera's own image."""
    matrix = [160.0, 0.0, 139.5, 0.0, 100.0, 119.5, 0.0, 0.0, 1.0]
    path = network(tmp_path / "net.onnx", matrix)
    rolled = FramesConfig(base_from_camera_xyzw=tuple(looking(roll_deg=90)))
    on_its_side = replace(config(tiny_sequence, str(path)), frames=rolled)
    _, camera = estimated_camera(on_its_side, threading.Event())
    across, down = 48 / 320, 64 / 240
    assert (camera.width, camera.height) == (64, 48)
    assert [camera.fx, camera.fy] == pytest.approx([100 * down, 160 * across])
    # Turned clockwise, the upright picture's left is the camera's lower edge.
    assert [camera.cx, camera.cy] == pytest.approx([120 * down - 0.5, 47 - (140 * across - 0.5)])


def test_the_part_of_a_pair_that_knows_is_asked(tiny_sequence: Path, tmp_path: Path):
    path = network(tmp_path / "net.onnx")
    other = write_tiny_network(tmp_path / "relative.onnx", TinyNetwork(depth_kind="inverse_relative"))
    _, camera = estimated_camera(config(tiny_sequence, f"nested:{other},{path}"), threading.Event())
    assert camera.fx == pytest.approx(12)


def test_the_median_withstands_an_outlier_and_the_spread_tells_of_it():
    estimates = np.tile([500.0, 510, 320, 240], (5, 1))
    assert median_camera(estimates, 640, 480)[1] == pytest.approx(0.0, abs=1e-9)
    estimates[2] = [5000, 5000, 10, 10]
    camera, spread = median_camera(estimates, 640, 480)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (500, 510, 320, 240)
    assert spread > 0.1


def test_without_intrinsics_it_is_said_what_to_do(tiny_sequence: Path, tmp_path: Path):
    plain = write_tiny_network(tmp_path / "plain.onnx")
    with pytest.raises(ConfigError, match=r"predicts no intrinsics; give a camera file"):
        estimated_camera(config(tiny_sequence, str(plain)), threading.Event())
    with pytest.raises(ConfigError, match="needs a depth network"):
        estimated_camera(config(tiny_sequence, ""), threading.Event())
    silent = network(tmp_path / "silent.onnx", [0.0] * 9)
    with pytest.raises(SourceError, match="found no intrinsics"):
        estimated_camera(config(tiny_sequence, str(silent)), threading.Event())


def test_an_answer_that_is_no_camera_is_none(tiny_sequence: Path, tmp_path: Path):
    far_off = network(tmp_path / "far.onnx", [60.0, 0.0, 900.0, 0.0, 80.0, 119.5, 0.0, 0.0, 1.0])
    with pytest.raises(SourceError, match=r"found no intrinsics .* \(the last it said can't be: cx: "):
        estimated_camera(config(tiny_sequence, str(far_off)), threading.Event())


def test_the_error_of_a_network_camera_holds_no_password(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = network(tmp_path / "net.onnx")
    monkeypatch.setattr(uncalibrated, "_first_images", lambda config, stopped: iter(()))
    address = config(Path(), str(path))
    address = replace(address, source=SourceConfig("rtsp://me:secret@cam/live?key=secret", "auto"))
    with pytest.raises(SourceError, match="rtsp://cam/live") as error:
        estimated_camera(address, threading.Event())
    assert "secret" not in str(error.value)


def test_being_stopped_ends_the_wait_for_a_camera_that_is_to_be_judged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """It would go on for `absent_s`, past all that a stop may take; and is no error then."""
    path = network(tmp_path / "net.onnx")
    begun = config(Path(), str(path))
    absent = SourceConfig(f"v4l2:{tmp_path}/video0", "auto", absent_s=45.0)
    with running(lambda bus: main(replace(begun, source=absent), bus)) as bus:  # type: ignore[arg-type]
        until(lambda: "estimating the camera" in bus.budgets)
    assert "ready" not in bus.states


def test_auto_goes_before_a_camera_file_beside_the_images(tiny_sequence: Path):
    assert open_source(SourceConfig(uri=str(tiny_sequence))).camera.fx == 60
    assert open_source(SourceConfig(uri=str(tiny_sequence), camera="auto")).camera is UNCALIBRATED
