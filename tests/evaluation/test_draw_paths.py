"""The picture of paths: metres to pixels, for points whose place is known."""

from __future__ import annotations

import numpy as np
import pytest

from prism_edge.evaluation.draw_paths import ESTIMATE, TRUTH, draw_paths, grid_step


def drawn(picture: np.ndarray, colour: tuple[int, int, int]) -> np.ndarray:
    """Pixels (n, 2), x y, that have exactly a path's colour, without the legend."""
    y, x = np.nonzero((picture == colour).all(axis=2))
    legend = (y < 160) & (x < 140)
    return np.stack([x, y], axis=1)[~legend]


def test_x_points_right_y_points_up_and_both_have_one_scale() -> None:
    square = np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 1.0]])  # 2 m to the right, then 1 m up
    pixels = drawn(draw_paths([("path", ESTIMATE, square)], "title"), ESTIMATE)
    left, right = pixels[:, 0].min(), pixels[:, 0].max()
    width, height = right - left, pixels[:, 1].max() - pixels[:, 1].min()
    assert width / height == pytest.approx(2.0, rel=0.05)
    highest = pixels[pixels[:, 1] == pixels[:, 1].min()]
    assert highest[:, 0].mean() > right - 10  # at the right end


def test_what_is_not_finite_is_left_out_and_nothing_at_all_is_refused() -> None:
    path = np.array([[0.0, 0.0], [np.nan, 1.0], [1.0, 1.0]])
    assert len(drawn(draw_paths([("path", TRUTH, path)], ""), TRUTH))
    with pytest.raises(ValueError, match="no points"):
        draw_paths([("path", TRUTH, np.full((2, 2), np.nan))], "")
    nothing = ("other", ESTIMATE, np.full((2, 2), np.nan))
    assert len(drawn(draw_paths([nothing, ("path", TRUTH, path)], ""), TRUTH))


def test_a_camera_that_stands_still_is_drawn() -> None:
    assert len(drawn(draw_paths([("path", ESTIMATE, np.zeros((3, 2)))], ""), ESTIMATE))


@pytest.mark.parametrize(
    ("extent", "step"), [(0.1, 0.05), (1.5, 0.2), (7.0, 1.0), (800.0, 100.0), (9e4, 11250.0)]
)
def test_grid_lines_are_few(extent: float, step: float) -> None:
    assert grid_step(extent) == step
    assert extent / grid_step(extent) <= 9
