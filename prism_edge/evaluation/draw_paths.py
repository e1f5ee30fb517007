"""Draws paths from above: true and estimated, on a grid in metres."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from prism_edge.messages import U8

F64 = NDArray[np.float64]
Colour = tuple[int, int, int]  # blue, green, red

WHITE, GRID, INK = (255, 255, 255), (225, 225, 225), (60, 60, 60)
TRUTH, ESTIMATE = (160, 160, 160), (200, 90, 20)
WIDTH, HEIGHT, MARGIN = 900, 700, 80
FONT = cv2.FONT_HERSHEY_SIMPLEX
STEPS_M = (0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)


def grid_step(extent_m: float) -> float:
    """The distance of grid lines that gives about eight of them over ``extent_m``."""
    return next((step for step in STEPS_M if extent_m / step <= 9), extent_m / 8)


def draw_paths(paths: list[tuple[str, Colour, F64]], title: str) -> U8:
    """A BGR picture of named paths (n, 2): x to the right, y up, one metre as long on both axes.

    Raises ValueError where there is no finite point to draw.
    """
    points = np.concatenate([path for _, _, path in paths])
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        raise ValueError("no points to draw")
    low, high = points.min(axis=0), points.max(axis=0)
    centre, extent = (low + high) / 2, max(float((high - low).max()), 0.1)
    room = np.array([WIDTH, HEIGHT]) - 2 * MARGIN
    pixels_per_m = 0.92 * float((room / np.maximum(high - low, 0.1)).min())
    middle = np.array([WIDTH / 2, HEIGHT / 2])

    def pixel(metres: F64) -> NDArray[np.int32]:
        return np.round(middle + (metres - centre) * [pixels_per_m, -pixels_per_m]).astype(np.int32)

    picture = np.full((HEIGHT, WIDTH, 3), WHITE, np.uint8)
    _grid(picture, centre, pixels_per_m, grid_step(extent))
    for row, (name, colour, path) in enumerate(paths):
        finite = path[np.isfinite(path).all(axis=1)]
        cv2.polylines(picture, [pixel(finite)], False, colour, 3 if row == 0 else 2, cv2.LINE_AA)
        for start in pixel(finite[:1]).tolist():
            cv2.circle(picture, start, 6, colour, -1, cv2.LINE_AA)
        y = MARGIN + 24 + 24 * row
        cv2.line(picture, (MARGIN + 14, y - 5), (MARGIN + 44, y - 5), colour, 3, cv2.LINE_AA)
        cv2.putText(picture, name, (MARGIN + 54, y), FONT, 0.5, INK, 1, cv2.LINE_AA)
    cv2.putText(picture, title, (MARGIN, 40), FONT, 0.6, INK, 1, cv2.LINE_AA)
    return picture


def _grid(picture: U8, centre: F64, pixels_per_m: float, step: float) -> None:
    """Grid lines with their metres, the frame, and the names of the axes."""
    left, right, top, bottom = MARGIN, WIDTH - MARGIN, MARGIN, HEIGHT - MARGIN
    half = np.array([right - left, bottom - top]) / 2 / pixels_per_m
    first = np.ceil((centre - half) / step).astype(int)
    last = np.floor((centre + half) / step).astype(int)
    for k in range(first[0], last[0] + 1):
        x = round(WIDTH / 2 + (k * step - centre[0]) * pixels_per_m)
        cv2.line(picture, (x, top), (x, bottom), GRID, 1)
        _label(picture, f"{k * step:g}", x, bottom + 22)
    for k in range(first[1], last[1] + 1):
        y = round(HEIGHT / 2 - (k * step - centre[1]) * pixels_per_m)
        cv2.line(picture, (left, y), (right, y), GRID, 1)
        _label(picture, f"{k * step:g}", left - 28, y + 5)
    cv2.rectangle(picture, (left, top), (right, bottom), INK, 1)
    _label(picture, "x, forward at the start (m)", WIDTH // 2, HEIGHT - 22)
    name = np.full((20, 220, 3), WHITE, np.uint8)
    _label(name, "y, left at the start (m)", 110, 15)
    turned = cv2.rotate(name, cv2.ROTATE_90_COUNTERCLOCKWISE)
    picture[HEIGHT // 2 - 110 : HEIGHT // 2 + 110, 8:28] = turned


def _label(picture: U8, text: str, x: int, y: int) -> None:
    (width, _), _ = cv2.getTextSize(text, FONT, 0.45, 1)
    cv2.putText(picture, text, (x - width // 2, y), FONT, 0.45, INK, 1, cv2.LINE_AA)
