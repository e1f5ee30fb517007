"""Warnings of one process: each by itself, and all of them on `health`."""

from __future__ import annotations

from prism_edge.bus.warnings import Warnings


def test_each_takes_back_its_own() -> None:
    values = {"fps": "30.0"}
    warn = Warnings(values)
    warn("speed", "too slow")
    warn("clock", "behind")
    assert values["warning"] == "too slow; behind"
    warn("speed", "slower yet")
    assert values["warning"] == "slower yet; behind", "in the order in which they came"
    warn("speed", "")
    assert values["warning"] == "behind"
    warn("clock", "")
    assert values == {"fps": "30.0"}


def test_what_was_never_wrong_is_well() -> None:
    values: dict[str, str] = {}
    Warnings(values)("speed", "")
    assert values == {}
