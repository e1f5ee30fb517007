"""The tree of settings: its defaults obey its own rules, and every key explains itself."""

from __future__ import annotations

import typing

import pytest

from prism_edge.config import Config
from prism_edge.config_file import Leaf, leaves

LEAVES = list(leaves())


@pytest.mark.parametrize("leaf", LEAVES, ids=lambda leaf: leaf.key)
def test_default_obeys_its_own_bounds(leaf: Leaf) -> None:
    items = leaf.default if isinstance(leaf.default, tuple) else (leaf.default,)
    item_type = typing.get_args(leaf.type)[0] if isinstance(leaf.default, tuple) else leaf.type
    assert all(type(item) is item_type or (item_type is float and type(item) is int) for item in items)
    assert leaf.low is None or all(item >= leaf.low for item in items)
    assert leaf.high is None or all(item <= leaf.high for item in items)
    assert not leaf.choices or all(item in leaf.choices for item in items)
    assert leaf.length is None or len(leaf.default) == leaf.length


@pytest.mark.parametrize("leaf", LEAVES, ids=lambda leaf: leaf.key)
def test_every_key_has_one_line_of_help(leaf: Leaf) -> None:
    assert leaf.help
    assert "\n" not in leaf.help


@pytest.mark.parametrize("leaf", LEAVES, ids=lambda leaf: leaf.key)
def test_numbers_are_bounded(leaf: Leaf) -> None:
    assert leaf.type not in (int, float) or (leaf.low is not None and leaf.high is not None)


@pytest.mark.parametrize("leaf", LEAVES, ids=lambda leaf: leaf.key)
def test_the_least_beside_0_is_in_bounds(leaf: Leaf) -> None:
    if leaf.least is not None:
        assert leaf.low == 0
        assert leaf.high is not None
        assert 0 < leaf.least <= leaf.high
        assert leaf.default == 0 or leaf.default >= leaf.least


def test_mode_decides_lockstep() -> None:
    assert not Config().is_lockstep
    assert Config(mode="lockstep").is_lockstep
