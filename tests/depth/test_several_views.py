"""A network of several pictures and poses, whose every answer follows from what it is given."""

from __future__ import annotations

import os
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper
from onnx.external_data_helper import set_external_data

from prism_edge.cli.main import main
from prism_edge.config import DepthConfig
from prism_edge.depth import open_onnx, several_views
from prism_edge.depth.contract import ModelCard
from prism_edge.depth.offline import open_offline
from prism_edge.depth.registry import File, sha256_of
from prism_edge.depth.several_views import LEAST_UNIT, SeveralViewsNetwork, unit_of
from prism_edge.errors import ModelError
from prism_edge.geometry.cameras import Camera
from prism_edge.geometry.poses import from_rt, so3_exp
from tests.depth.test_providers import CPU, CUDA, FAINTED, Border
from tests.synthetic.network import POOL, TinyNetwork, save, write_tiny_network
from tests.synthetic.tint import log_depth_weights

VIEWS, WIDTH, HEIGHT = 3, 32, 24
UNIT = 5.0  # how much larger its own world is than the one it is given
CAMERA = Camera(64, 48, 60.0, 50.0, 31.5, 23.5)
POSES = np.array(
    [
        from_rt(so3_exp(np.array([0.1, 0.3, -0.2])), np.array([4.0, -1.0, 2.0])),
        from_rt(so3_exp(np.array([0.1, 0.2, -0.2])), np.array([4.8, -1.0, 2.3])),
        from_rt(so3_exp(np.array([0.0, 0.3, -0.1])), np.array([4.0, 0.5, 1.5])),
    ]
)


def write(
    path: Path,
    outputs: tuple[str, ...] = ("depth", "predicted_extrinsics"),
    size: tuple[int, int] = (WIDTH, HEIGHT),
    tinted: bool = False,
    **card: object,
) -> Path:
    """depth: 1 + the red of each pixel, or what its tint says; poses: those given, UNIT times as far."""
    width, height = size
    weights, offset = log_depth_weights()
    constants = {
        "red": np.array([0], np.int64),
        "channel": np.array([1], np.int64),
        "one": np.ones(1, np.float32),
        "weights": weights.reshape(1, 3, 1, 1).astype(np.float32),
        "offset": np.array([offset], np.float32),
        "stretch": np.where(np.arange(4) < 3, 1.0, UNIT).astype(np.float32).reshape(1, 1, 4),
        "rows": np.arange(3, dtype=np.int64),
    }
    pool = [POOL, POOL]
    says_red = [
        helper.make_node("Gather", ["image", "red"], ["reds"], axis=1),
        helper.make_node("Squeeze", ["reds", "channel"], ["plane"]),
        helper.make_node("Add", ["plane", "one"], ["depth"]),
    ]
    says_tint = [
        helper.make_node("AveragePool", ["image"], ["small"], kernel_shape=pool, strides=pool),
        helper.make_node("Conv", ["small", "weights", "offset"], ["log_depth"]),
        helper.make_node("Exp", ["log_depth"], ["deep"]),
        helper.make_node("Squeeze", ["deep", "channel"], ["depth"]),
    ]
    nodes = [
        *(says_tint if tinted else says_red),
        helper.make_node("Add", ["depth", "one"], ["confidence"]),
        helper.make_node("Gather", ["extrinsics", "rows"], ["top"], axis=1),
        helper.make_node("Mul", ["top", "stretch"], ["predicted_extrinsics"]),
        helper.make_node("Identity", ["intrinsics"], ["predicted_intrinsics"]),
    ]
    takes = {"image": [VIEWS, 3, height, width], "extrinsics": [VIEWS, 4, 4], "intrinsics": [VIEWS, 3, 3]}
    shrunk = POOL if tinted else 1
    plane = [VIEWS, height // shrunk, width // shrunk]
    gives = {"depth": plane, "confidence": plane, "predicted_extrinsics": [VIEWS, 3, 4]}
    gives["predicted_intrinsics"] = [VIEWS, 3, 3]
    graph = helper.make_graph(
        nodes,
        "several",
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, size) for name, size in takes.items()],
        [
            helper.make_tensor_value_info(name, TensorProto.FLOAT, gives[name])
            for name in (*outputs, "predicted_intrinsics")
        ],
        [numpy_helper.from_array(value, name) for name, value in constants.items()],
    )
    values = {
        "name": "several",
        "revision": "1",
        "licence": "Apache-2.0",
        "depth_kind": "relative",
        "input_width": width,
        "input_height": height,
        "input_name": "image",
        "levels": "kept",
        "depth_output": "depth",
        "views": VIEWS,
    }
    save(path, graph, ModelCard(**(values | card)))
    return path


def pictures(seed: int = 0) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    return [np.full((48, 64, 3), rng.integers(10, 250, 3), np.uint8) for _ in range(VIEWS)]


def opened(path: Path) -> SeveralViewsNetwork:
    network = open_offline(str(path), DepthConfig())
    assert isinstance(network, SeveralViewsNetwork)
    return network


def test_depth_is_in_the_unit_of_the_poses(tmp_path: Path) -> None:
    """Its world is given with the median distance from the first view as 1, and it sees that UNIT times."""
    network = opened(write(tmp_path / "net.onnx"))
    given = pictures()
    made = network.infer(given, [CAMERA] * VIEWS, POSES)
    distances = np.linalg.norm(POSES[:, :3, 3] - POSES[0, :3, 3], axis=1)
    metres = np.median(distances) / UNIT
    for rgb, answer in zip(given, made, strict=True):
        # A picture of one colour has one depth, which counts as none.
        assert not answer.valid
        assert f"{metres * (1 + rgb[0, 0, 0] / 255):.3g} m" in answer.reason


def test_weights_overwritten_under_it_are_noticed(tmp_path: Path) -> None:
    """Mapped into memory, they would be others from now on, or end the process."""
    path = write(tmp_path / "net.onnx", tinted=True, size=(64, 48))
    model = onnx.load(str(path))
    for constant in model.graph.initializer:
        if constant.name == "weights":
            set_external_data(constant, "net.data")
    onnx.save(model, str(path))
    network = opened(path)
    network.infer(pictures(), [CAMERA] * VIEWS, POSES)
    os.utime(tmp_path / "net.data", ns=(0, 1))  # a write within the clock's tick would go unseen
    with pytest.raises(ModelError, match=r"net\.data: was overwritten while the network runs"):
        network.infer(pictures(), [CAMERA] * VIEWS, POSES)


def test_each_answer_took_its_share_of_the_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    network = opened(write(tmp_path / "net.onnx"))
    clock = SimpleNamespace(perf_counter=iter([10.0, 10.0 + 0.1 * VIEWS]).__next__)
    monkeypatch.setattr(several_views, "time", clock)
    answers = network.infer(pictures(), [CAMERA] * VIEWS, POSES)
    assert [answer.inference_ms for answer in answers] == pytest.approx([100.0] * VIEWS)


def test_where_its_file_is_pinned_no_other_is_taken(tmp_path: Path) -> None:
    path = write(tmp_path / "net.onnx")
    pinned = (File(path.name, sha256_of(path)),)
    assert SeveralViewsNetwork(path, DepthConfig(), pinned).views == VIEWS
    with pytest.raises(ModelError, match="not the registered 000000000000"):
        SeveralViewsNetwork(path, DepthConfig(), (File(path.name, 64 * "0"),))


@pytest.mark.parametrize(("views", "unit"), [(1, 0.1), (2, 0.1), (3, 1.0), (4, 1.0), (5, 2.0), (6, 2.0)])
def test_the_unit_of_an_even_number_of_views_is_the_lower_one_in_the_middle(views: int, unit: float) -> None:
    """Cameras 1 m apart on a line; torch.median(torch.tensor([0., 1., 2., 3.])) is 1."""
    assert unit_of(np.arange(views, dtype=float)[::-1, None] * [-1.0, 0.0, 0.0]) == pytest.approx(unit)


def test_the_next_provider_runs_it_where_a_gpu_is_full(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    path = write(tmp_path / "net.onnx")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    Border(monkeypatch, cuda="faints")
    network = open_offline(str(path), DepthConfig(providers=("cuda",)))
    assert network.provider == CPU
    assert caplog.messages == [f"cuda does not run net.onnx: {FAINTED}; trying the next"]
    assert network.infer(pictures(), [CAMERA] * VIEWS, POSES)
    with pytest.raises(ModelError, match=r"^cuda is required, but can't run net\.onnx: the first inf"):
        open_offline(str(path), DepthConfig(providers=("cuda",), required=("cuda",)))
    Border(monkeypatch, cuda="starts")
    assert open_offline(str(path), DepthConfig(providers=("cuda",))).provider == CUDA


def test_what_it_is_given(tmp_path: Path) -> None:
    outputs = ("depth", "predicted_extrinsics", "confidence")
    network = opened(write(tmp_path / "net.onnx", outputs, confidence_output="confidence"))
    fed: dict[str, np.ndarray] = {}
    session = network._session

    class Spy:
        def run(self, outputs: list[str], feed: dict[str, np.ndarray]) -> list[np.ndarray]:
            fed.update(feed)
            return session.run(outputs, feed)

    network._session = Spy()  # type: ignore[assignment]
    rng = np.random.default_rng(1)
    given = [rng.integers(0, 255, (48, 64, 3), dtype=np.uint8) for _ in range(VIEWS)]
    made = network.infer(given, [CAMERA] * VIEWS, POSES)
    unit = np.median(np.linalg.norm(POSES[:, :3, 3] - POSES[0, :3, 3], axis=1))
    np.testing.assert_allclose(fed["extrinsics"][0], np.eye(4), atol=1e-6)
    for i in range(VIEWS):
        camera_from_first = np.linalg.inv(POSES[i]) @ POSES[0]
        np.testing.assert_allclose(fed["extrinsics"][i][:3, :3], camera_from_first[:3, :3], atol=1e-6)
        np.testing.assert_allclose(fed["extrinsics"][i][:3, 3] * unit, camera_from_first[:3, 3], atol=1e-6)
    np.testing.assert_allclose(fed["intrinsics"][0], [[30, 0, 15.5], [0, 25, 11.5], [0, 0, 1]], atol=1e-5)
    assert all(answer.valid for answer in made)
    np.testing.assert_allclose(made[1].image_to_depth, [0.5, -0.25, 0.5, -0.25])
    reds = given[1][..., 0].reshape(24, 2, 32, 2).mean(axis=(1, 3))
    np.testing.assert_allclose(made[1].depth, unit / UNIT * (1 + reds / 255), rtol=1e-4)
    np.testing.assert_allclose(made[1].confidence, 2 + reds / 255, rtol=1e-4)


def test_cameras_in_one_place_have_the_unit_that_they_were_given(tmp_path: Path) -> None:
    network = opened(write(tmp_path / "net.onnx"))
    rng = np.random.default_rng(1)
    given = [rng.integers(0, 255, (48, 64, 3), dtype=np.uint8) for _ in range(VIEWS)]
    made = network.infer(given, [CAMERA] * VIEWS, np.tile(POSES[0], (VIEWS, 1, 1)))
    reds = given[2][..., 0].reshape(24, 2, 32, 2).mean(axis=(1, 3))
    np.testing.assert_allclose(made[2].depth, LEAST_UNIT * (1 + reds / 255), rtol=1e-4)


def test_pictures_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    network = opened(write(tmp_path / "net.onnx"))
    with pytest.raises(ModelError, match="takes 3 pictures, not 2"):
        network.infer(pictures()[:2], [CAMERA] * 2, POSES[:2])
    with pytest.raises(ModelError, match=r"is not of its 64x48 camera"):
        network.infer([np.zeros((48, 60, 3), np.uint8)] * 3, [CAMERA] * 3, POSES)


def test_files_that_are_not_what_they_say_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="has no output predicted_extrinsics"):
        opened(write(tmp_path / "a.onnx", ("depth",)))
    with pytest.raises(ModelError, match="a network of 4 views takes image"):
        opened(write(tmp_path / "b.onnx", views=4))
    path = write_tiny_network(tmp_path / "c.onnx", TinyNetwork(describes_itself=False))
    model = onnx.load(path)
    card = TinyNetwork().card()
    helper.set_model_props(model, {**card.to_metadata(), "prism_edge.views": "2"})
    onnx.save(model, str(path))
    with pytest.raises(ModelError, match="a network of 2 views takes"):
        opened(path)


def test_it_is_verified_and_described_as_what_it_is(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "400")
    path = str(write(tmp_path / "net.onnx"))
    assert main(["models", "verify", path]) == 0
    assert "3 pictures at once, for `prism-edge reconstruct` alone" in capsys.readouterr().out
    assert main(["models", "info", path]) == 0
    shown = capsys.readouterr().out
    assert "It takes 3 pictures and their poses at once: use it with `prism-edge reconstruct`." in shown
    assert sha256_of(Path(path)) in shown
    assert "nested:" not in shown


def test_the_daemon_has_no_use_for_it(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="the daemon runs networks of one"):
        open_onnx(str(write(tmp_path / "net.onnx")), DepthConfig())
