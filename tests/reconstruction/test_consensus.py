"""Who agrees with whom, where the truth is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from prism_edge.reconstruction.consensus import consensus
from prism_edge.reconstruction.look import Look
from prism_edge.scale.gate import GateParameters
from tests.reconstruction.room import COUNT, log_errors, looks

TOLERANCE = 0.03
GATE = GateParameters(0.5, 0.1, 0.02)


def others(number: int, among: dict) -> list:
    return [among[j] for j in range(COUNT) if j != number]


def boxed(look: Look) -> np.ndarray:
    """Pixels at which the box stands."""
    return np.abs(np.log(look.view.depth / looks()[3].view.depth)) > 0.1


def with_view(look: Look, **changes: object) -> Look:
    return replace(look, view=replace(look.view, **changes))


def test_exact_depths_agree_and_stay() -> None:
    found = consensus(looks()[3], others(3, looks()), TOLERANCE, None)
    assert found.kept(3).mean() > 0.9
    assert np.percentile(np.abs(log_errors(np.where(found.kept(3), found.depth, 0), 3)), 95) < 0.01
    assert (found.weights == 1.0).all()


def test_what_only_one_keyframe_saw_is_not_kept() -> None:
    """A box before the camera that the others look through."""
    with_box = looks(with_box_in=3)
    box = boxed(with_box[3])
    assert box.sum() > 200
    for gate in (None, GATE):
        found = consensus(with_box[3], others(3, with_box), TOLERANCE, gate)
        assert found.kept(2)[box].mean() < 0.02
        assert found.kept(2)[~box].mean() > 0.85
    assert np.median(found.through[box]) >= 3
    assert found.weights[box].mean() < 0.05, "and the gate takes it for something that moves"
    assert np.median(found.weights[~box]) > 0.9


def test_who_looks_through_outvotes_who_agrees() -> None:
    """A box that two of eight saw, in the same place."""
    with_box = looks(with_box_in=3)[3]
    box = boxed(with_box)
    found = consensus(with_box, [with_box, *others(3, looks())], TOLERANCE, None)
    assert np.median(found.agreeing[box]) == 2
    assert found.kept(2)[box].mean() < 0.05


def test_the_mean_of_depths_that_waver_is_nearer_to_the_truth() -> None:
    rng = np.random.default_rng(0)
    noise = {k: np.exp(0.008 * rng.normal(size=look.view.depth.shape)) for k, look in looks().items()}
    noisy = {k: look.with_depth(np.float32(look.view.depth * noise[k])) for k, look in looks().items()}
    found = consensus(noisy[3], others(3, noisy), TOLERANCE, None)
    kept = found.kept(4)
    before = log_errors(np.where(kept, noisy[3].view.depth, 0), 3)
    after = log_errors(np.where(kept, found.depth, 0), 3)
    assert np.std(after) < 0.6 * np.std(before)


def test_one_that_nobody_is_beside_is_its_own_word() -> None:
    found = consensus(looks()[0], [], TOLERANCE, GATE)
    assert (found.agreeing == 1).all()
    np.testing.assert_array_equal(found.depth, looks()[0].view.depth)
    assert not found.kept(2).any()
    assert found.kept(1).all()


def test_a_network_that_doubts_a_pixel_closes_the_gate_there() -> None:
    confidence = np.full(looks()[3].view.depth.shape, 50.0, np.float32)
    confidence[:40] = 1.01
    found = consensus(with_view(looks()[3], confidence=confidence), others(3, looks()), TOLERANCE, GATE)
    assert (found.weights[:40] < 0.05).all()
    assert found.kept(2)[:40].sum() == 0
    assert found.kept(2)[45:].mean() > 0.9


def test_pixels_without_depth_are_nobodys() -> None:
    holed = looks()[3].view.depth.copy()
    holed[:60] = 0.0
    found = consensus(looks()[3].with_depth(holed), others(3, looks()), TOLERANCE, GATE)
    assert not found.kept(1)[:60].any()
    assert np.isfinite(found.depth).all()
