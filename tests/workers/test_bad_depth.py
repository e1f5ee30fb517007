"""Depth that goes bad midway, through the whole system: nothing breaks, `status` says so, it recovers."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from prism_edge.depth.prediction import Prediction, no_descriptor
from prism_edge.tracking.depth_watch import MUTE, DepthWatch
from prism_edge.workers.tracker import TrackerWorker
from tests.workers.whole_system import Spoil, WholeSystem, finite, in_turn

FRAMES, BAD = 220, range(40, 110)


def filled(value: float) -> Spoil:
    return lambda good: replace(good, depth=np.full_like(good.depth, value))


def holes(good: Prediction) -> Prediction:
    depth = good.depth.copy()
    depth[:, ::2] = np.inf
    depth[::2] = np.nan
    return replace(good, depth=depth)


def confidence(value: float) -> Spoil:
    return lambda good: replace(good, confidence=np.full_like(good.depth, value))


UNUSABLE: dict[str, tuple[Spoil, str]] = {
    "unusable": (
        in_turn(filled(np.nan), filled(2.0), filled(np.inf), filled(-1.0), filled(0.0), holes),
        "no usable depth: ",
    ),
    "stops": (lambda good: None, "no depth for "),
}


@pytest.mark.parametrize("case", UNUSABLE)
def test_without_depth_it_tracks_on_degraded_and_recovers(case: str) -> None:
    spoil, says = UNUSABLE[case]
    system = WholeSystem(spoil, BAD)
    bus = system.play(FRAMES)
    words, errors = system.words(), system.errors()
    assert finite(bus)
    assert len(errors) == FRAMES - 1, "a pose for each frame but the first"
    assert max(errors.values()) < 0.06, "the shape is the map's, which stands"
    assert any(reason.startswith(says) for reason in system.reasons().values())
    assert words[BAD[0] - 5] == "ok"
    assert words[BAD[-1] - 4] == "degraded"
    assert {word for i, word in words.items() if i > BAD[-1] + 25} == {"ok"}, "recovered"
    sigmas = [scale.filter_sigma for scale in system.scales]
    assert all(np.isfinite(sigmas))


def test_depth_ten_times_off_is_told_and_left_when_it_is_over() -> None:
    bad = range(40, 100)  # time for three keyframes or four: one or two are outliers like any other
    system = WholeSystem(lambda good: replace(good, depth=10 * good.depth), bad)
    bus = system.play(270)
    words, errors = system.words(), system.errors()
    assert finite(bus)
    assert len(errors) == 269
    assert max(v for i, v in errors.items() if i < bad[-1]) < 0.06, "a belief isn't given up at once"
    assert words[bad[-1] - 4] == "degraded"
    assert system.reasons()[bad[-1] - 4] == "depth contradicts the scale"
    assert words[265] == "ok"
    assert errors[269] < 0.06


def test_other_outputs_of_the_network_gone_wrong_change_nothing() -> None:
    spoil = in_turn(
        confidence(np.nan),
        confidence(0.0),
        confidence(np.inf),
        lambda good: replace(good, descriptor=np.ones_like(good.descriptor)),
        lambda good: replace(good, descriptor=good.descriptor * np.float32(np.nan)),
        lambda good: replace(good, descriptor=no_descriptor()),
        lambda good: replace(good, descriptor=np.ones(7, np.float32)),
    )
    system = WholeSystem(spoil, range(FRAMES))
    bus = system.play(FRAMES)
    assert finite(bus)
    assert len(system.errors()) == FRAMES - 1
    assert max(system.errors().values()) < 0.06
    assert set(system.words().values()) == {"initialising", "ok"}


@pytest.mark.parametrize("bias", [1e308, 1e200, 2.01, -1.0, float("nan"), float("inf")])
def test_a_bias_that_no_card_may_say_is_not_said(bias: float) -> None:
    """A tracker that died of it would find it again in each of its lives, as the map's known scale."""
    system, said = WholeSystem(), iter(range(FRAMES))
    system.on_the_way = lambda depth: replace(depth, bias_sigma=bias) if next(said) else depth
    bus = system.play(90)
    assert finite(bus)
    assert len(system.errors()) == 89
    assert max(system.errors().values()) < 0.06
    assert {scale.bias_sigma for scale in system.scales} == {system.scales[0].bias_sigma}


def test_depth_that_could_never_tell_the_scale_is_said_though_the_scale_knows_no_metres_yet() -> None:
    watch = DepthWatch()
    worker = SimpleNamespace(_tracker=SimpleNamespace(epoch=0), _status=SimpleNamespace(metres=watch))
    told = SimpleNamespace(log_scale=0.0, map_log_scale=0.0, sigma=0.3, local_sigma=0.1)
    told.observation, told.accepted = np.nan, False
    for epoch, said in ((1, ""), (0, "too few points")):  # of another map it says nothing
        mute = SimpleNamespace(**vars(told), epoch=epoch, metric=False)
        for number in range(MUTE):
            watch.depth(number, True, "")
            mute.keyframe = number
            TrackerWorker._apply_scale(worker, mute)  # type: ignore[arg-type]
        assert watch.trouble(0)[:14] == said
