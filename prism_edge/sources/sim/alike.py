"""Textures that come again and again: all of them the same picture, each with a little of its own."""

from __future__ import annotations

import cv2
import numpy as np

from prism_edge.messages import F32, U8
from prism_edge.sources.sim.textures import Colour, Painter, noise, tinted

_MARKS = 40  # on a square metre
_SMALLEST, _LARGEST = 0.005, 0.03  # m, half a mark's side
_CONTRAST, _MARKED = 0.06, 0.13  # standard deviations, of brightness


def repeated(
    base: Colour, density: float, unlike: float, seed: int, edge: tuple[int, int] = (0, 0)
) -> Painter:
    """A worn surface, the same picture whenever it is painted but for ``unlike`` of as much wear again.

    ``seed`` says which picture; the generator a painter is given says what is its own. ``density`` is in
    pixels a metre; ``edge`` pixels of the first and of the last rows are dark, as of steps.
    """

    def paint(rng: np.random.Generator, height: int, width: int) -> U8:
        brightness = _wear(np.random.default_rng(seed), height, width, density)
        brightness[: edge[0]] -= 0.2
        brightness[height - edge[1] :] -= 0.4
        if unlike:
            brightness += np.float32(unlike) * _wear(rng, height, width, density)
        return tinted(base, brightness)

    return paint


def _wear(rng: np.random.Generator, height: int, width: int, density: float) -> F32:
    """Brightness (h, w): blotches of several sizes and sharp marks."""
    brightness = np.float32(_CONTRAST) * noise(rng, height, width, (4, 16, 64))
    for _ in range(int(rng.poisson(_MARKS * height * width / density**2))):
        x, y = int(rng.integers(width)), int(rng.integers(height))
        half = density * rng.uniform(_SMALLEST, _LARGEST)
        left, right, up = (round(half * share) for share in (1.0, *rng.uniform(0.2, 2.0, 2)))
        shade = float(brightness[y, x] + _MARKED * rng.normal())
        cv2.rectangle(brightness, (x - left, y - up), (x + right, y + left), shade, -1)
    return brightness
