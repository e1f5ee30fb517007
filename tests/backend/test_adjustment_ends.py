"""How an adjustment of everything ends where it goes wrong: at all, and without harm to the map."""

from __future__ import annotations

from types import SimpleNamespace

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import L, X

from prism_edge.backend import global_adjustment as module
from prism_edge.backend import lens
from prism_edge.backend.global_adjustment import MOST_STEPS, GlobalAdjustment
from tests.backend.test_global_adjustment import CONFIG, shaken


def begun(said_k1: float | None = None) -> GlobalAdjustment:
    return GlobalAdjustment(shaken()[1], CONFIG, 1.0, use_depth=False, said_k1=said_k1)


def test_where_nothing_holds_a_direction_what_there_is_so_far_has_to_do(monkeypatch):
    """gtsam raises: the backend's process would end, and again with the same map."""
    job = begun()
    assert not job.step()

    def indeterminate() -> None:
        raise RuntimeError("Indeterminant linear system detected")

    stuck = SimpleNamespace(iterate=indeterminate, values=job._optimiser.values)
    monkeypatch.setattr(job, "_optimiser", stuck)
    assert job.step()
    adjusted = job.result()
    assert adjusted is not None
    assert adjusted.steps == 1


def test_it_ends_though_each_step_gains_something(monkeypatch):
    monkeypatch.setattr(module, "CONVERGED", -np.inf)
    job, steps = begun(), 1
    while not job.step() and steps < 10 * MOST_STEPS:
        steps += 1
    assert steps == MOST_STEPS


@pytest.mark.parametrize("key", [X(3), L(7)])
def test_places_that_are_no_numbers_are_not_taken(monkeypatch, key):
    job = begun()
    values = gtsam.Values(job._optimiser.values())
    wrong = np.full(3, np.nan)
    values.update(key, gtsam.Pose3(gtsam.Rot3(), wrong) if key == X(3) else wrong)
    monkeypatch.setattr(job, "_optimiser", SimpleNamespace(values=lambda: values))
    assert job.result() is None


def test_a_map_that_goes_with_a_lens_nobody_can_be_sure_of_is_not_taken(monkeypatch):
    monkeypatch.setattr(lens, "found", lambda *_: None)
    job = begun(said_k1=0.0)
    while not job.step():
        pass
    assert job.result() is None
