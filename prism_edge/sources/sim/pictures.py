"""What hangs, stands and lies about in rooms: posters, pages, books, screens, windows, boxes, faces.

The same kind of painters as in textures.py: (generator, height, width) to BGR uint8 (h, w, 3).
"""

from __future__ import annotations

import cv2
import numpy as np

from prism_edge.messages import U8
from prism_edge.sources.sim.textures import Colour, colour, noise, tinted

_LETTERS = "ABCDEFGHIJKLMNOPRSTUVWXYZabcdefghiklmnoprstuvwxyz0123456789"
_FONTS = (
    cv2.FONT_HERSHEY_SIMPLEX,
    cv2.FONT_HERSHEY_DUPLEX,
    cv2.FONT_HERSHEY_COMPLEX,
    cv2.FONT_HERSHEY_TRIPLEX,
)


def _word(rng: np.random.Generator) -> str:
    letters = rng.integers(0, len(_LETTERS), 9).tolist()
    return "".join(_LETTERS[i] for i in letters[: 2 + letters[-1] % 7])


def _random_colour(rng: np.random.Generator, value: tuple[float, float] = (0.3, 0.95)) -> Colour:
    return colour(rng.random(), rng.uniform(0.05, 0.7), rng.uniform(*value))


def _ink(background: Colour, rng: np.random.Generator) -> Colour:
    dark = float(background.mean()) > 120
    return _random_colour(rng, (0.05, 0.3)) if dark else colour(rng.random(), 0.15, rng.uniform(0.8, 1.0))


def _write(
    image: U8, rng: np.random.Generator, box: tuple[int, int, int, int], pixels: float, ink: Colour
) -> None:
    """Fills box (x0, y0, x1, y1) with lines of words of ``pixels`` height."""
    x0, y0, x1, y1 = box
    font = int(rng.choice(_FONTS))
    size = pixels / 30.0
    y = y0 + pixels
    while y < y1:
        x, end = float(x0), x0 + (x1 - x0) * rng.uniform(0.55, 1.0)
        while x < end:
            word = _word(rng)
            (width, _), _ = cv2.getTextSize(word, font, size, 1)
            if x + width > x1:
                break
            place = (round(x), round(y))
            cv2.putText(image, word, place, font, size, ink.tolist(), max(1, round(pixels / 11)), cv2.LINE_AA)
            x += width + 0.6 * pixels
        y += 1.7 * pixels


def photograph(rng: np.random.Generator, height: int, width: int) -> U8:
    """A picture of nothing in particular: regions of colour with soft and hard edges."""
    size = min(height, width)
    cells = (max(3.0, size / 30), max(5.0, size / 10), size / 3)
    first, second, third = (_random_colour(rng, (0.1, 1.0)) for _ in range(3))
    field = noise(rng, height, width, cells)
    share = (1.0 / (1.0 + np.exp(-6.0 * field)))[:, :, None]
    regions = first + share * (second - first)
    other = noise(rng, height, width, cells[1:])
    regions = np.where((other > rng.uniform(-0.2, 0.8))[:, :, None], 0.4 * regions + 0.6 * third, regions)
    image = tinted(regions.astype(np.float32), 0.10 * noise(rng, height, width, (2.5, 6.0)))
    for _ in range(int(rng.integers(2, 6))):
        centre = (int(rng.integers(width)), int(rng.integers(height)))
        axes = (int(rng.uniform(0.05, 0.25) * size) + 1, int(rng.uniform(0.05, 0.25) * size) + 1)
        ink = _random_colour(rng, (0.05, 1.0)).tolist()
        if rng.random() < 0.5:
            cv2.ellipse(image, centre, axes, rng.uniform(0, 180), 0, 360, ink, -1, cv2.LINE_AA)
        else:
            corner = (centre[0] + axes[0], centre[1] + axes[1])
            cv2.rectangle(image, centre, corner, ink, -1)
    return image


def poster(rng: np.random.Generator, height: int, width: int) -> U8:
    """A printed sheet: heading, picture and text on a coloured ground."""
    ground = _random_colour(rng, (0.6, 1.0)) if rng.random() < 0.7 else _random_colour(rng, (0.1, 0.4))
    image = np.empty((height, width, 3), dtype=np.uint8)
    image[:] = ground.astype(np.uint8)
    ink = _ink(ground, rng)
    margin = max(2, round(0.06 * width))
    heading = 0.09 * height
    _write(image, rng, (margin, margin, width - margin, round(margin + 1.4 * heading)), heading, ink)
    top = round(margin + 1.9 * heading)
    split = round(top + rng.uniform(0.3, 0.65) * (height - top))
    if split - top > 8 and width - 2 * margin > 8:
        image[top:split, margin : width - margin] = photograph(rng, split - top, width - 2 * margin)
    size = max(4.0, 0.028 * height)
    _write(image, rng, (margin, split + round(size), width - margin, height - margin), size, ink)
    return image


def page(rng: np.random.Generator, height: int, width: int) -> U8:
    """A sheet of print on white, often with a figure."""
    image = np.full((height, width, 3), int(rng.integers(225, 253)), dtype=np.uint8)
    ink = colour(rng.random(), 0.2, rng.uniform(0.05, 0.35))
    margin = max(2, round(0.08 * width))
    size = max(4.0, rng.uniform(0.025, 0.05) * height)
    top = margin
    if rng.random() < 0.6:
        bottom = round(height * rng.uniform(0.3, 0.5))
        if bottom - top > 8 and width - 2 * margin > 8:
            image[top:bottom, margin : width - margin] = photograph(rng, bottom - top, width - 2 * margin)
        top = bottom
    _write(image, rng, (margin, top, width - margin, height - margin), size, ink)
    return image


def cover(rng: np.random.Generator, height: int, width: int) -> U8:
    """The front of a magazine or book: strong colour, large title."""
    image = photograph(rng, height, width) if rng.random() < 0.4 else poster(rng, height, width)
    band = round(height * rng.uniform(0.15, 0.3))
    ground = _random_colour(rng)
    image[:band] = ground.astype(np.uint8)
    _write(image, rng, (round(0.07 * width), 0, width, band), 0.55 * band, _ink(ground, rng))
    return image


def books(rng: np.random.Generator, height: int, width: int) -> U8:
    """A row of spines; height of the image is that of the tallest books."""
    image = np.full((height, width, 3), 24, dtype=np.uint8)
    x = 0
    while x < width:
        thick = max(4, round(height * rng.uniform(0.07, 0.24)))
        top = round(height * rng.uniform(0.0, 0.3))
        ground = _random_colour(rng, (0.15, 0.95))
        spine = tinted(ground, 0.05 * noise(rng, height - top, thick, (3, 9)))
        spine[:, :1] = (spine[:, :1] * 0.5).astype(np.uint8)
        if thick >= 8:
            strip = np.empty((thick, height - top, 3), dtype=np.uint8)
            strip[:] = spine.transpose(1, 0, 2)
            size = 0.45 * thick
            box = (round(0.1 * (height - top)), round(0.1 * thick), round(0.9 * (height - top)), thick)
            _write(strip, rng, box, size, _ink(ground, rng))
            spine = strip.transpose(1, 0, 2)
        for _ in range(int(rng.integers(0, 3))):
            y = int(rng.integers(height - top))
            spine[y : y + 3] = _random_colour(rng).astype(np.uint8)
        image[top:, x : x + thick] = spine[:, : width - x]
        x += thick
        if rng.random() < 0.06:
            x += round(height * rng.uniform(0.05, 0.25))
    return image


def screen(rng: np.random.Generator, height: int, width: int) -> U8:
    """A monitor that is on: a dark frame round windows of text and pictures."""
    image = np.full((height, width, 3), 18, dtype=np.uint8)
    edge = max(2, round(0.04 * width))
    inside = image[edge:-edge, edge:-edge]
    inside[:] = colour(rng.uniform(0.5, 0.65), 0.6, rng.uniform(0.4, 0.8)).astype(np.uint8)
    for _ in range(3):
        h, w = inside.shape[:2]
        y0, x0 = int(rng.uniform(0, 0.5) * h), int(rng.uniform(0, 0.5) * w)
        y1, x1 = min(h, y0 + h // 2), min(w, x0 + w // 2)
        inside[y0:y1, x0:x1] = page(rng, y1 - y0, x1 - x0)
    return image


def window(rng: np.random.Generator, height: int, width: int) -> U8:
    """A bright view outdoors between bars."""
    y = np.linspace(0.0, 1.0, height, dtype=np.float32)[:, None, None]
    sky = colour(0.58, 0.15, 1.0) * (1 - y) + colour(0.55, 0.05, 1.0) * y
    image = np.repeat(sky, width, axis=1).astype(np.float32)
    horizon = height * rng.uniform(0.45, 0.65) + 0.06 * height * noise(rng, 1, width, (20, 60))[0]
    below = np.arange(height)[:, None] > horizon[None]
    leaves = tinted(colour(rng.uniform(0.2, 0.35), 0.4, 0.6), 0.3 * noise(rng, height, width, (3, 8, 25)))
    image[below] = leaves[below]
    out = image.astype(np.uint8)
    bar = max(3, round(0.03 * width))
    for x in np.linspace(0, width - 1, int(rng.integers(3, 5))):
        cv2.line(out, (round(x), 0), (round(x), height), (235, 235, 235), bar)
    for y0 in (0, height // 2, height - 1):
        cv2.line(out, (0, y0), (width, y0), (235, 235, 235), bar)
    return out


def carton(rng: np.random.Generator, height: int, width: int) -> U8:
    """Packaging: cardboard or print with a label."""
    brown = colour(rng.uniform(0.07, 0.11), rng.uniform(0.3, 0.55), rng.uniform(0.5, 0.8))
    ground = brown if rng.random() < 0.5 else _random_colour(rng)
    image = tinted(ground, 0.05 * noise(rng, height, width, (3, 10, 40)))
    w, h = round(width * rng.uniform(0.4, 0.9)), round(height * rng.uniform(0.3, 0.8))
    if w > 10 and h > 10:
        y, x = int(rng.integers(0, height - h + 1)), int(rng.integers(0, width - w + 1))
        image[y : y + h, x : x + w] = cover(rng, h, w)
    return image


def face(rng: np.random.Generator, height: int, width: int) -> U8:
    """A head seen from in front, as simply as a doll's."""
    image = tinted(
        colour(0.06, rng.uniform(0.3, 0.55), rng.uniform(0.5, 0.95)),
        0.04 * noise(rng, height, width, (4, 12)),
    )
    hair = colour(rng.uniform(0.02, 0.12), 0.6, rng.uniform(0.1, 0.6))
    image[: height // 4] = tinted(hair, 0.2 * noise(rng, height // 4, width, (2, 5)))
    for side in (0.3, 0.7):
        centre = (round(side * width), round(0.45 * height))
        cv2.ellipse(
            image,
            centre,
            (max(2, width // 10), max(1, height // 18)),
            0,
            0,
            360,
            (240, 240, 240),
            -1,
            cv2.LINE_AA,
        )
        cv2.circle(image, centre, max(1, width // 22), (40, 30, 20), -1, cv2.LINE_AA)
    cv2.line(
        image,
        (round(0.35 * width), round(0.75 * height)),
        (round(0.65 * width), round(0.75 * height)),
        (60, 50, 140),
        2,
    )
    return image
