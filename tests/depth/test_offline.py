"""Which network is opened how, for work after the run."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from prism_edge.config import DepthConfig
from prism_edge.depth.contract import INVERSE_RELATIVE, METRIC, RELATIVE
from prism_edge.depth.offline import UnscaledNetwork, open_offline
from prism_edge.depth.pairing import PairedNetwork
from prism_edge.depth.registry import find
from prism_edge.depth.session import OnnxNetwork
from prism_edge.errors import ModelError
from prism_edge.geometry.cameras import Camera
from tests.synthetic.network import TinyNetwork, write_tiny_network
from tests.synthetic.sequence import synthetic_camera
from tests.synthetic.tint import tinted

CAMERA: Camera = synthetic_camera(320, 240)


def network(folder: Path, kind: str, **more: object) -> str:
    return str(write_tiny_network(folder / f"{kind}.onnx", TinyNetwork(name=kind, depth_kind=kind, **more)))


def picture() -> tuple[np.ndarray, np.ndarray]:
    """RGB, and the depth that a tiny network reads in it."""
    depth = np.tile(np.linspace(1.0, 4.0, 320, dtype=np.float32), (240, 1))
    return np.ascontiguousarray(tinted(np.full((240, 320), 120, np.uint8), depth)[..., ::-1]), depth


def test_one_with_metres_is_as_the_daemon_runs_it(tmp_path: Path) -> None:
    assert isinstance(open_offline(network(tmp_path, METRIC), DepthConfig()), OnnxNetwork)
    pair = f"nested:{network(tmp_path, INVERSE_RELATIVE)},{network(tmp_path, METRIC)}"
    assert isinstance(open_offline(pair, DepthConfig()), PairedNetwork)


@pytest.mark.parametrize("kind", [RELATIVE, INVERSE_RELATIVE])
def test_one_without_says_what_it_says(tmp_path: Path, kind: str) -> None:
    opened = open_offline(network(tmp_path, kind, gain=3.0), DepthConfig())
    assert isinstance(opened, UnscaledNetwork)
    assert opened.kind == kind
    rgb, depth = picture()
    answer = opened.infer(rgb, CAMERA)
    truth = depth[2::4, 2::4]
    expected = 3.0 / truth if kind == INVERSE_RELATIVE else 3.0 * truth
    assert answer.valid
    np.testing.assert_allclose(answer.depth[5:-5, 5:-5], expected[5:-5, 5:-5], rtol=0.03)


def test_by_a_registered_name_the_registered_file_alone_is_opened(tmp_path: Path, monkeypatch) -> None:
    entry = find("prism_nano")
    assert entry is not None
    assert open_offline("prism_nano", DepthConfig()).name == "prism_nano"
    monkeypatch.setenv("PRISM_EDGE_MODELS", str(tmp_path))
    write_tiny_network(tmp_path / entry.file)
    with pytest.raises(ModelError, match=f"not the registered {entry.files[0].sha256[:12]}"):
        open_offline("prism_nano", DepthConfig())


def test_what_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="there is no such file"):
        open_offline(str(tmp_path / "none.onnx"), DepthConfig())
    with pytest.raises(ModelError, match="nested takes two networks"):
        open_offline("nested:a", DepthConfig())
