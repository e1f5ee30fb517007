"""The bundled network: that it is what the registry says, and that it sees simulated rooms it never saw."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from prism_edge.config import DepthConfig
from prism_edge.depth import locate, open_network
from prism_edge.depth.registry import data_folder, find, sha256_of
from prism_edge.sources.sim import SimSource

LARGEST = 8_000_000  # bytes


@pytest.fixture(scope="module")
def network():
    return open_network("prism_nano", DepthConfig())


@pytest.fixture(scope="module")
def seen(network):
    """(prediction, true depth at its pixels) of eight frames a second apart, in each of three rooms."""
    out = []
    for seed in (11, 12, 13):
        with SimSource(f"sim:room?seed={seed}&speed=0.5") as source:
            for index in range(0, 240, 30):
                picture = cv2.cvtColor(source.image(index).pixels, cv2.COLOR_BGR2RGB)
                prediction = network.infer(picture, source.camera)
                size = prediction.depth.shape[::-1]
                truth = cv2.resize(source.depth(index), size, interpolation=cv2.INTER_NEAREST)
                out.append((prediction, truth))
    return out


def test_the_file_is_the_registered_one_and_small() -> None:
    entry = find("prism_nano")
    assert entry is not None
    assert entry.card is not None
    path = data_folder() / entry.file
    assert sha256_of(path) == entry.card.sha256
    assert path.stat().st_size <= LARGEST
    assert Path(locate("prism_nano")).name == path.name


def test_its_own_card_and_the_registry_say_the_same(network) -> None:
    entry = find("prism_nano")
    assert entry is not None
    for key in ("revision", "licence", "canonical_focal_length", "scale_bias_sigma", "dsug_tau"):
        assert getattr(network.card, key) == getattr(entry.card, key), key
    assert network.card.dsug_tau > 0
    assert network.card.scale_bias_sigma >= 0.05


def test_metres_in_rooms_it_never_saw(seen) -> None:
    errors = [np.mean(np.abs(p.depth / truth - 1)) for p, truth in seen]
    ratios = [np.median(truth / p.depth) for p, truth in seen]
    assert all(prediction.valid for prediction, _ in seen)
    assert np.mean(errors) < 0.16
    assert np.median(ratios) == pytest.approx(1.0, abs=0.08)


def test_confidence_is_the_inverse_of_an_expected_relative_error_that_tells_good_from_bad(seen) -> None:
    real = np.concatenate([np.abs(np.log(p.depth / truth)).ravel() for p, truth in seen])
    expected = np.concatenate([1.0 / p.confidence.ravel() for p, _ in seen])
    assert 0.005 <= expected.min() <= expected.max() <= 1.0
    surest = np.mean(real[expected <= np.quantile(expected, 0.3)])
    least_sure = np.mean(real[expected >= np.quantile(expected, 0.7)])
    assert least_sure > 1.3 * surest
    assert 0.5 < real.mean() / expected.mean() < 2.0


def test_descriptors_have_norm_one_and_know_a_place_again(network) -> None:
    """Each of twelve directions from the middle of a room, and again from a step aside."""
    here, again = [], []
    room = "sim:room?seed=21&path=turn"
    with SimSource(room) as first, SimSource(f"{room}&noise=3") as second:
        for k in range(12):
            for source, index, kept in ((first, 45 * k, here), (second, 45 * k + 12, again)):
                picture = cv2.cvtColor(source.image(index).pixels, cv2.COLOR_BGR2RGB)
                kept.append(network.infer(picture, source.camera).descriptor)
    alike = np.array(here) @ np.array(again).T
    assert np.linalg.norm(here, axis=1) == pytest.approx(np.ones(12), abs=1e-4)
    assert np.mean(alike.argmax(axis=1) == np.arange(12)) >= 0.75
