"""What is painted again and again: the same picture, with as much of its own as was asked for."""

from __future__ import annotations

import numpy as np
import pytest

from prism_edge.sources.sim.alike import repeated
from prism_edge.sources.sim.textures import colour

GREY = colour(0.0, 0.0, 0.5)


def painted(unlike: float, own: int, which: int = 3, size: tuple[int, int] = (160, 240)) -> np.ndarray:
    paint = repeated(GREY, 200.0, unlike, which)
    return paint(np.random.default_rng(own), *size).astype(np.float64)


@pytest.mark.parametrize("size", [(160, 240), (120, 600)])
def test_without_a_difference_all_are_the_same(size: tuple[int, int]) -> None:
    assert np.array_equal(painted(0.0, 1, size=size), painted(0.0, 2, size=size))
    assert not np.array_equal(painted(0.0, 1, size=size), painted(0.0, 1, which=4, size=size))


def test_the_more_unlike_the_less_two_are_like_each_other() -> None:
    def alike(unlike: float) -> float:
        return float(np.corrcoef(painted(unlike, 1).ravel(), painted(unlike, 2).ravel())[0, 1])

    likeness = [alike(unlike) for unlike in (0.0, 0.1, 0.3, 1.0)]
    assert likeness == sorted(likeness, reverse=True)
    assert likeness[1] > 0.95
    assert 0.3 < likeness[3] < 0.7  # half of each picture's variance is its own


def test_one_that_is_painted_again_is_the_same_again() -> None:
    assert np.array_equal(painted(0.5, 1), painted(0.5, 1))


def test_edges_are_darker_than_what_lies_between() -> None:
    paint = repeated(GREY, 200.0, 0.0, 3, edge=(5, 9))
    rows = paint(np.random.default_rng(0), 100, 300).mean(axis=(1, 2))
    assert rows[:5].max() < rows[5:91].min()
    assert rows[91:].max() < rows[:5].min()
