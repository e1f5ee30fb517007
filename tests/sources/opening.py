"""Sources opened by their folder, for the tests of what is recognised."""

from __future__ import annotations

from pathlib import Path

import pytest

from prism_edge.config import SourceConfig
from prism_edge.errors import PrismError
from prism_edge.sources import Image, Source, Unreadable, open_source


def opened(folder: Path, **settings: object) -> Source:
    return open_source(SourceConfig(uri=str(folder), **settings))  # type: ignore[arg-type]


def all_of(source: Source) -> list[Image | Unreadable]:
    with source:
        items = []
        while (item := source.read()) is not None:
            items.append(item)
        assert source.peek() is None
        return items


def refusal(folder: Path, **settings: object) -> PrismError:
    """The error of opening; its text must be one line."""
    with pytest.raises(PrismError) as caught, opened(folder, **settings):
        pass
    assert "\n" not in str(caught.value)
    return caught.value
