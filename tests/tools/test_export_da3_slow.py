"""The large checkpoints and the variant of five views: minutes each, so only `pytest -m slow` runs them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnxruntime
import pytest

from prism_edge.config import DepthConfig
from prism_edge.depth import open_network
from prism_edge.depth.offline import open_offline
from prism_edge.depth.session import OnnxNetwork
from prism_edge.depth.several_views import SeveralViewsNetwork
from prism_edge.errors import ModelError
from prism_edge.geometry.alignment import align
from prism_edge.geometry.cameras import Camera
from tests.tools.exporter import export

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1800)]

HEIGHT, WIDTH = 98, 126
BOUNDS = {"": 1e-4, "_fp16": 2e-2}
CAMERA = Camera(640, 480, 525.0, 525.0, 320.0, 240.0)
SIZE = ["--height", HEIGHT, "--width", WIDTH]


def _within_bounds(errors: dict[str, dict[str, float]], stem: str) -> None:
    for suffix, bound in BOUNDS.items():
        found = errors[f"{stem}{suffix}.onnx"]
        assert max(found.values()) <= bound, found
    assert f"{stem}_int8.onnx" in errors  # the tool would not have kept it beyond its bound


def _noise(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 255, (480, 640, 3), dtype=np.uint8)


def test_metric_large_gives_metres_and_leaves_out_the_sky(tmp_path: Path):
    path = tmp_path / "metric.onnx"
    errors = export(
        *(path, "--random-weights", 1, "--model", "da3metric-large", *SIZE),
        *("--precision", "fp32", "fp16", "int8"),
    )
    _within_bounds(errors, "metric")
    assert set(errors["metric.onnx"]) == {"depth", "sky", "descriptor"}
    for suffix in ("", "_fp16", "_int8"):
        network = open_network(str(tmp_path / f"metric{suffix}.onnx"), DepthConfig())
        answer = network.infer(_noise(1), CAMERA)
        assert answer.descriptor.shape == (4 * 1024,)
    session = onnxruntime.InferenceSession(str(path))
    network = OnnxNetwork(path)
    flat = np.full((480, 640, 3), 124, np.uint8)  # so that how it is resized does not matter
    value = (124 / 255 - np.array([0.485, 0.456, 0.406])) / np.array([0.229, 0.224, 0.225])
    image = np.broadcast_to(value.astype(np.float32)[None, :, None, None], (1, 3, HEIGHT, WIDTH))
    depth, sky = session.run(["depth", "sky"], {"image": np.ascontiguousarray(image)})
    focal = np.sqrt(525.0 * WIDTH / 640 * 525.0 * HEIGHT / 480)
    ground = sky[0] < 0.3
    assert 0.05 < ground.mean() < 0.95
    raw = network.raw(flat)[0].depth
    assert raw[~ground].max(initial=0.0) == 0.0
    answer = network.infer(flat, CAMERA)
    if answer.valid:
        assert answer.depth[ground] == pytest.approx(depth[0][ground] * focal / 300.0, rel=1e-4)


def test_a_relative_and_a_metric_network_become_one_with_metres(tmp_path: Path):
    path = tmp_path / "nested.onnx"
    errors = export(
        *(path, "--random-weights", 3, "--model", "da3-small", "--metric", "-", *SIZE),
        *("--precision", "fp32", "fp16", "int8", "--intrinsics"),
    )
    _within_bounds(errors, "nested")
    assert set(errors["nested.onnx"]) == {"depth", "confidence", "descriptor", "intrinsics", "sky"}
    network = open_network(str(path), DepthConfig())
    assert network.card.depth_kind == "focal_normalised"
    assert network.card.canonical_focal_length == 300.0
    answer = network.infer(_noise(2), CAMERA)
    assert answer.confidence.shape == answer.depth.shape
    assert network.intrinsics(_noise(2)) is not None


def test_five_views_are_conditioned_on_their_poses_and_not_for_the_daemon(tmp_path: Path):
    path = tmp_path / "views.onnx"
    errors = export(
        *(path, "--random-weights", 1, "--model", "da3-small", "--views", 5, "--rays", *SIZE),
        *("--precision", "fp32", "fp16"),
    )
    assert max(errors["views.onnx"].values()) <= 1e-4
    assert max(errors["views_fp16.onnx"].values()) <= 2e-2
    session = onnxruntime.InferenceSession(str(path))
    shapes = {item.name: item.shape for item in session.get_inputs()}
    assert shapes == {"image": [5, 3, HEIGHT, WIDTH], "extrinsics": [5, 4, 4], "intrinsics": [5, 3, 3]}
    rng = np.random.default_rng(0)
    poses = np.tile(np.eye(4, dtype=np.float32), (5, 1, 1))
    matrix = np.tile(np.array([[100, 0, 63], [0, 100, 49], [0, 0, 1]], np.float32), (5, 1, 1))
    feed = {"image": rng.normal(size=(5, 3, HEIGHT, WIDTH)).astype(np.float32), "intrinsics": matrix}
    still = session.run(["depth"], {**feed, "extrinsics": poses})[0]
    (cameras,) = session.run(["predicted_intrinsics"], {**feed, "extrinsics": poses})
    # The middle of the image, pixels counted from the first one's centre.
    assert cameras[:, :2, 2] == pytest.approx(np.tile([(WIDTH - 1) / 2, (HEIGHT - 1) / 2], (5, 1)), abs=1e-3)
    poses[3, 0, 3] = 1.0
    moved = session.run(["depth"], {**feed, "extrinsics": poses})[0]
    assert np.abs(moved / still - 1).max() > 1e-3
    with pytest.raises(ModelError, match="5 images at once"):
        OnnxNetwork(path)
    _what_reconstruct_makes_of_it(path, session)


def _what_reconstruct_makes_of_it(path: Path, session: onnxruntime.InferenceSession) -> None:
    """Its depth times the scale between the cameras that it predicts and those that it was given."""
    network = open_offline(str(path), DepthConfig())
    assert isinstance(network, SeveralViewsNetwork)
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, :3, 3] = np.random.default_rng(1).normal(size=(5, 3))
    pictures = [_noise(i) for i in range(5)]
    answers = network.infer(pictures, [CAMERA] * 5, poses)
    fed: dict[str, np.ndarray] = {}

    class Spy:
        def run(self, names: list[str], feed: dict[str, np.ndarray]) -> list[np.ndarray]:
            fed.update(feed)
            return session.run(names, feed)

    network._session = Spy()  # type: ignore[assignment]
    network.infer(pictures, [CAMERA] * 5, poses)
    depth, predicted = session.run(["depth", "predicted_extrinsics"], fed)
    centres = -np.einsum("nji,nj->ni", predicted[:, :, :3], predicted[:, :, 3])
    scale = align(centres, poses[:, :3, 3] - poses[0, :3, 3], with_scale=True).scale
    for answer, own in zip(answers, depth, strict=True):
        assert answer.valid
        assert answer.depth == pytest.approx(own * scale, rel=1e-3)
