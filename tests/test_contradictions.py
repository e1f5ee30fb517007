"""Pairs of keys that are each in their bounds and can't go together."""

from __future__ import annotations

from dataclasses import replace

import pytest

from prism_edge.config import Config, DepthConfig, NetworkConfig, SourceConfig
from prism_edge.config_file import leaves
from prism_edge.contradictions import NOT_ABOVE, contradictions

KEYS = {leaf.key: leaf for leaf in leaves()}


def test_the_defaults_have_none() -> None:
    assert list(contradictions(Config())) == []


def test_a_network_that_runs_elsewhere_is_named_here_too() -> None:
    """Else nobody waits for depth, and nobody watches it."""
    away = replace(Config(), network=NetworkConfig(endpoint="tcp/0.0.0.0:7448", remote=("depth",)))
    (said,) = contradictions(away)
    assert "network.remote" in said
    assert "depth.model" in said
    assert list(contradictions(replace(away, depth=DepthConfig(model="net.onnx")))) == []
    assert list(contradictions(replace(away, source=SourceConfig(uri="sim:room")))) == []  # has one anyway


def test_in_lockstep_the_first_image_waits_for_those_it_is_for() -> None:
    at_once = replace(Config(), source=SourceConfig(peers_s=0.0))
    assert list(contradictions(at_once)) == []
    (said,) = contradictions(replace(at_once, mode="lockstep"))
    assert said.startswith("source.peers_s: 0 in lockstep")


@pytest.mark.parametrize(("low", "high"), [pair[:2] for pair in NOT_ABOVE])
def test_each_pair_is_of_one_section_and_of_one_kind(low: str, high: str) -> None:
    assert KEYS[low].type is KEYS[high].type
    assert low.partition(".")[0] == high.partition(".")[0]


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"min_matches": 601}, "tracking.min_matches: 601 is more than tracking.features (600): "),
        ({"features": 100, "min_matches": 100}, None),
        ({"keyframe_min_s": 2.0}, None),  # it wins: keyframes on a slow machine
    ],
)
def test_what_is_more_than_it_can_be_is_said(settings: dict[str, float], said: str | None) -> None:
    config = replace(Config(), tracking=replace(Config().tracking, **settings))  # type: ignore[arg-type]
    found = list(contradictions(config))
    assert len(found) == (said is not None)
    assert said is None or found[0].startswith(said)
