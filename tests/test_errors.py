"""How errors are said: an exception's first line."""

from __future__ import annotations

import pytest

from prism_edge.errors import first_line


@pytest.mark.parametrize(
    ("said", "line"),
    [
        ("no such key", "no such key"),
        ("\n  no such key  \nat key.cpp:12\n", "no such key  "),
        ("", "RuntimeError"),
        (" \n\n", "RuntimeError"),
    ],
)
def test_an_exception_is_its_first_line_or_its_type(said: str, line: str) -> None:
    assert first_line(RuntimeError(said)) == line


def test_a_long_line_is_cut() -> None:
    assert first_line(RuntimeError("x" * 300), 200) == "x" * 200
    assert first_line(RuntimeError("x" * 300)) == "x" * 300
