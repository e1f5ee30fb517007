"""One name, and yet another network: what tells."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from prism_edge.depth.contract import ModelCard
from prism_edge.depth.fingerprint import fingerprint
from prism_edge.depth.pairing import PairedNetwork
from prism_edge.depth.session import OnnxNetwork
from prism_edge.depth.vetting import Vetted, vet
from prism_edge.geometry.cameras import Camera
from prism_edge.messages import KeyframeImage, same_network
from prism_edge.workers.depth import answer
from tests.depth.test_vetting import split
from tests.synthetic.network import TinyNetwork, write_sidecar, write_tiny_network

WHAT = TinyNetwork(descriptor=True, describes_itself=False)


def opened(path: Path, **change: object) -> OnnxNetwork:
    write_sidecar(path, replace(WHAT.card(), **change))
    return OnnxNetwork(path)


@pytest.mark.parametrize(
    ("change", "is_same"),
    [
        ({"descriptor_output": "", "descriptor_layer": "small", "descriptor_pooling": "grid"}, False),
        ({"mean": (0.1, 0.1, 0.1)}, False),
        ({"depth_scale": 0.001}, False),
        ({"depth_scale": 1.0}, True),
        ({"depth_kind": "focal_normalised", "canonical_focal_length": 300.0}, False),
        ({"revision": "2"}, True),
        ({"source": "elsewhere", "scale_bias_sigma": 0.2}, True),
        ({"dsug_tau": 0.1, "dsug_temperature": 0.03}, True),
    ],
)
def test_what_in_a_card_shapes_answers_is_part_of_the_identity(tmp_path: Path, change, is_same: bool):
    path = write_tiny_network(tmp_path / "net.onnx", WHAT)
    before, after = opened(path), opened(path, **change)
    assert before.name == after.name == "tiny_tint"
    assert (before.identity == after.identity) == is_same
    assert same_network(before.identity, after.identity) == is_same
    assert same_network(after.identity, "tiny_tint")


def test_a_file_trained_anew_is_another_network(tmp_path: Path):
    one = opened(write_tiny_network(tmp_path / "a.onnx", WHAT))
    again = opened(write_tiny_network(tmp_path / "b.onnx", WHAT))
    other = opened(write_tiny_network(tmp_path / "c.onnx", replace(WHAT, gain=1.01)))
    assert one.identity == again.identity
    assert one.identity != other.identity


def test_so_is_one_whose_weights_lie_beside_it(tmp_path: Path):
    path = split(tmp_path / "net.onnx")
    before = fingerprint(WHAT.card(), vet(path))
    weights = np.fromfile(tmp_path / "weights.bin", np.float32)
    (weights * np.float32(1.01)).tofile(tmp_path / "weights.bin")
    after = fingerprint(WHAT.card(), vet(path))
    assert len(before) == len(after) == 12
    assert before != after


@pytest.mark.parametrize("at", [0, -1])
def test_of_large_weights_the_first_and_the_last_byte_count(tmp_path: Path, at: int):
    """Samples alone are read of them, from the one end to the other."""
    path, told = tmp_path / "weights.bin", []
    content = bytearray(3_000_000)
    for _ in range(2):
        path.write_bytes(content)
        told.append(fingerprint(WHAT.card(), Vetted(Path("net.onnx"), 64 * "0", {}, 17, (path,))))
        content[at] ^= 1
    assert told[0] != told[1]


def test_a_pair_is_another_with_another_part(tmp_path: Path):
    path = write_tiny_network(tmp_path / "r.onnx", TinyNetwork(name="r", depth_kind="inverse_relative"))
    relative, metric = OnnxNetwork(path), opened(write_tiny_network(tmp_path / "m.onnx", WHAT))
    pair = PairedNetwork(relative, metric)
    assert pair.name == "nested:r,tiny_tint"
    assert pair.identity == f"nested:{relative.identity},{metric.identity}"
    assert same_network(pair.identity, pair.name)
    other = PairedNetwork(relative, opened(metric.path, mean=(0.1, 0.1, 0.1)))
    assert not same_network(pair.identity, other.identity)


def test_depth_messages_carry_it(tmp_path: Path):
    network = opened(write_tiny_network(tmp_path / "net.onnx", WHAT))
    camera = Camera(320, 240, 300.0, 300.0, 160.0, 120.0)
    picture = np.random.default_rng(0).integers(0, 255, (240, 320, 3), dtype=np.uint8)
    image = KeyframeImage(0, 0, 0, 0, True, "pinhole", camera.to_array(), picture)
    assert answer(network, image).model == network.identity


def test_a_key_at_its_default_changes_no_network():
    """One that a card may have in time to come would tell every map's network from itself."""
    card = ModelCard("net", "1", "MIT", "metric", 320, 240, mean=(0.5, 0.5, 0.5))
    file = Vetted(Path("net.onnx"), 64 * "0", {}, 17, ())
    assert fingerprint(card, file) == "144b44850857"
