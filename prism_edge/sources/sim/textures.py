"""Patterns of surfaces, painted as arrays: noise, plaster, wood, tiles, cloth, doors of cupboards.

Each painter takes a random generator and a size in pixels and returns BGR uint8 (height, width, 3).
Detail comes in several scales and never as white noise, which no lens would resolve and which makes
features that nothing matches.
"""

from __future__ import annotations

import colorsys
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from prism_edge.messages import F32, U8

Painter = Callable[[np.random.Generator, int, int], U8]
Colour = NDArray[np.float32]
_SHEET = 640  # pixels


def colour(hue: float, saturation: float, value: float) -> Colour:
    """BGR (3,) in 0..255 of hue (turns), saturation and value in 0..1."""
    r, g, b = colorsys.hsv_to_rgb(hue % 1.0, saturation, value)
    return np.array([b, g, r], dtype=np.float32) * 255.0


def noise(
    rng: np.random.Generator, height: int, width: int, cells: Sequence[float], stretch: float = 1.0
) -> F32:
    """Smooth noise (height, width) of about unit standard deviation: a sum over grids of ``cells`` pixels.

    Larger cells weigh more, by the root of their size. ``stretch`` draws the cells out along x.
    """
    total = np.zeros((height, width), dtype=np.float32)
    for cell in cells:
        if max(height, width) < 0.7 * _SHEET:
            # Most textures are small and many: they are cut from one sheet of noise of about their scale.
            octave = _sheet(2.0 ** (round(4.0 * np.log2(cell)) / 4.0), stretch)
        else:
            octave = _octave(rng, height + 1, width + 1, cell, stretch)
        dy, dx = int(rng.integers(octave.shape[0] - height)), int(rng.integers(octave.shape[1] - width))
        total += np.float32(np.sqrt(cell)) * octave[dy : dy + height, dx : dx + width]
    return total * np.float32(1.4 / np.sqrt(sum(cells)))


def _octave(rng: np.random.Generator, height: int, width: int, cell: float, stretch: float) -> F32:
    """Noise of one scale, at least (height, width); a window cut out at random hides its grid."""
    rows, columns = int(height / cell) + 2, int(width / (cell * stretch)) + 2
    grid = rng.standard_normal((rows, columns), dtype=np.float32)
    size = (round(columns * cell * stretch), round(rows * cell))
    octave: F32 = cv2.resize(grid, size, interpolation=cv2.INTER_CUBIC)
    return octave


def forget_sheets() -> None:
    """Gives back the memory of what textures were cut from; painting again makes the same ones anew."""
    _sheet.cache_clear()


@lru_cache(maxsize=48)
def _sheet(cell: float, stretch: float) -> F32:
    rng = np.random.default_rng([round(1000 * cell), round(1000 * stretch)])
    return np.ascontiguousarray(_octave(rng, _SHEET, _SHEET, cell, stretch)[:_SHEET, :_SHEET])


def tinted(base: Colour, brightness: NDArray[np.floating[Any]]) -> U8:
    """A colour (3,) or image (h, w, 3) made lighter and darker by ``brightness`` (h, w), 0 for unchanged."""
    return np.clip(base * (1.0 + brightness[:, :, None]), 0.0, 255.0).astype(np.uint8)


def plaster(base: Colour, roughness: float = 0.02) -> Painter:
    """A painted wall: almost smooth, with blotches and a few scuffs."""

    def paint(rng: np.random.Generator, height: int, width: int) -> U8:
        image = tinted(base, roughness * noise(rng, height, width, (3, 9, 40, 130)))
        for _ in range(int(rng.integers(0, 2 + width * height // 20_000))):
            x, y = int(rng.integers(width)), int(rng.integers(height))
            end = (x + int(rng.integers(-12, 13)), y + int(rng.integers(-5, 6)))
            cv2.line(image, (x, y), end, (base * rng.uniform(0.75, 0.92)).tolist(), 1, cv2.LINE_AA)
        return image

    return paint


def wood(base: Colour, plank: float = 0.0, contrast: float = 0.10) -> Painter:
    """Grain along x; planks of ``plank`` pixels height where it is not 0, each with its own shade."""

    def paint(rng: np.random.Generator, height: int, width: int) -> U8:
        grain = contrast * noise(rng, height, width, (2, 4, 10), stretch=14.0)
        rings = noise(rng, height, width, (24, 60), stretch=7.0)
        brightness = grain + 0.5 * contrast * np.sin(6.0 * rings)
        if plank:
            for row in range(int(np.ceil(height / plank))):
                top, bottom = round(row * plank), min(round((row + 1) * plank), height)
                joint = rng.uniform(0, width)
                for left, right in ((0, joint), (joint, width)):
                    brightness[top:bottom, round(left) : round(right)] += rng.normal(0.0, 0.09)
                brightness[top : top + 1] -= 0.35
                brightness[top:bottom, round(joint) : round(joint) + 1] -= 0.35
        for _ in range(int(rng.poisson(width * height / 60_000))):
            centre = (int(rng.integers(width)), int(rng.integers(height)))
            cv2.ellipse(brightness, centre, (5, 2), 0, 0, 360, -0.3, -1, cv2.LINE_AA)
        return tinted(base, brightness)

    return paint


def tiles(base: Colour, side: float, grout: float, variation: float = 0.05) -> Painter:
    """Square tiles of ``side`` pixels with darker or lighter joints (``grout``: relative brightness)."""

    def paint(rng: np.random.Generator, height: int, width: int) -> U8:
        rows, columns = int(height / side) + 2, int(width / side) + 2
        shades = rng.normal(0.0, variation, (rows, columns)).astype(np.float32)
        y, x = np.arange(height) / side, np.arange(width) / side
        brightness = shades[np.ix_(y.astype(int), x.astype(int))]
        brightness = brightness + 0.025 * noise(rng, height, width, (3, 8, 25))
        joint = 1.6 / side
        brightness[(y % 1.0) < joint, :] = grout
        brightness[:, (x % 1.0) < joint] = grout
        return tinted(base, brightness)

    return paint


def carpet(base: Colour, stripes: bool) -> Painter:
    """Woven floor cloth: tufts, wear, and broken stripes where asked for."""

    def paint(rng: np.random.Generator, height: int, width: int) -> U8:
        brightness = 0.06 * noise(rng, height, width, (2, 4)) + 0.05 * noise(rng, height, width, (30, 90))
        if stripes:
            brightness += 0.16 * np.sign(noise(rng, height, width, (4, 9), stretch=16.0))
            brightness = cv2.GaussianBlur(brightness, (0, 0), 0.7)
        return tinted(base, brightness)

    return paint


def cloth(base: Colour, second: Colour, kind: int) -> Painter:
    """Upholstery and clothes: plain weave, checks or stripes (``kind`` 0, 1, 2)."""

    def paint(rng: np.random.Generator, height: int, width: int) -> U8:
        y, x = np.mgrid[:height, :width].astype(np.float32)
        period = float(rng.uniform(14, 30))
        share = np.zeros((height, width), dtype=np.float32)
        if kind == 1:
            share = 0.4 * ((x % period < period / 3).astype(np.float32) + (y % period < period / 3))
        elif kind == 2:
            share = (y % period < period / 2).astype(np.float32)
        mixed = base + share[:, :, None] * (second - base)
        folds = 0.05 * noise(rng, height, width, (2, 5)) + 0.10 * noise(rng, height, width, (25, 60))
        return tinted(mixed, folds)

    return paint


def cupboard(base: Colour, doors: int, handle: Colour, drawers: int = 1) -> Painter:
    """Fronts of doors or drawers with joints and handles on a smooth, slightly worn colour."""

    def paint(rng: np.random.Generator, height: int, width: int) -> U8:
        image = tinted(base, 0.022 * noise(rng, height, width, (4, 15, 60)))
        for column in range(doors):
            left, right = round(column * width / doors), round((column + 1) * width / doors) - 1
            for row in range(drawers):
                top, bottom = round(row * height / drawers), round((row + 1) * height / drawers) - 1
                cv2.rectangle(image, (left, top), (right, bottom), (base * 0.35).tolist(), 2)
                cv2.line(
                    image, (left + 3, top + 3), (right - 3, top + 3), np.minimum(base * 1.3, 255).tolist(), 1
                )
                reach, y = (right - left) * 0.18, top + max(6, (bottom - top) * 0.12)
                centre = (left + right) / 2
                ends = (round(centre - reach), round(y)), (round(centre + reach), round(y))
                cv2.line(
                    image,
                    (ends[0][0], ends[0][1] + 2),
                    (ends[1][0], ends[1][1] + 2),
                    (base * 0.45).tolist(),
                    3,
                )
                cv2.line(image, *ends, handle.tolist(), 2, cv2.LINE_AA)
        return image

    return paint


def ceiling(base: Colour, panel: float) -> Painter:
    """Panels with joints and fine holes."""

    def paint(rng: np.random.Generator, height: int, width: int) -> U8:
        image = tiles(base, panel, -0.25, 0.015)(rng, height, width)
        specks = noise(rng, height, width, (2.5,)) > 2.1
        image[specks] = (image[specks] * 0.86).astype(np.uint8)
        return image

    return paint


def plain(base: Colour, roughness: float = 0.03) -> Painter:
    """A smooth surface with faint wear: metal, plastic, lacquer."""

    def paint(rng: np.random.Generator, height: int, width: int) -> U8:
        return tinted(base, roughness * noise(rng, height, width, (3, 10, 40)))

    return paint
