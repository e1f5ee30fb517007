"""Rendered views as training examples: cropped, mirrored, stretched, and spoilt as real cameras spoil.

Everything random comes from the seed and the number of the step, so a batch is the same on every run.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from tools.train_nano.ruler import CANONICAL_FOCAL, HEIGHT, MEAN, STD, WIDTH

U8 = NDArray[np.uint8]
F32 = NDArray[np.float32]

WORLDS, PAIRS = 4, 4  # of a batch; each pair is two views of one place
_ASPECT = 4 / 3  # of most cameras; a picture is stretched to the network's own
NEARBY = 1.0  # m; views this far apart are 0.6 as close as their overlap says
FARTHEST = 20.0  # m; beyond it a room has nothing (the renderer writes infinity where it draws nothing)
_GRAIN = np.random.default_rng(0).standard_normal((256, 256, 3), dtype=np.float32)


class Batch(NamedTuple):
    """Pictures (n, 3, h, w), focal-normalised depth (n, h/2, w/2) with 0 for none, overlap (n, n)."""

    image: F32
    depth: F32
    overlap: F32


class Views:
    """What ``render`` wrote, read as needed."""

    def __init__(self, folder: Path) -> None:
        """Raises SystemExit, in one line, for a folder that holds no rendered views."""
        if not (folder / "views.npz").is_file():
            raise SystemExit(f"{folder}: no rendered views there; tools.train_nano.render makes them")
        self.images: U8 = np.load(folder / "images.npy", mmap_mode="r", allow_pickle=False)
        self.depths = np.load(folder / "depth.npy", mmap_mode="r", allow_pickle=False)
        with np.load(folder / "views.npz", allow_pickle=False) as file:
            self.world, self.focal, self.overlap = file["world"], file["focal"], file["overlap"]
            self.position = file["pose"][:, :3, 3]
        self.pose_count = len(self.world)
        self._first = {int(w): int(np.argmax(self.world == w)) for w in np.unique(self.world)}

    def batch(self, width: int, height: int, narrowest: float, *seed: int) -> Batch:
        """The training batch of a seed, ``width`` x ``height`` pixels; crops are ``narrowest`` to 1 wide."""
        rng = np.random.default_rng(seed)
        rows, mirrored = self._choose(rng)
        chosen = zip(rows, mirrored, strict=True)
        parts = [self._example(row, flip, width, height, narrowest, rng) for row, flip in chosen]
        image, depth = (np.stack(part) for part in zip(*parts, strict=True))
        return Batch(image, depth, self.shared(rows))

    def whole(self, rows: NDArray[np.int64], width: int, height: int) -> Batch:
        """Some views as they are, stretched to ``width`` x ``height``: what a network is judged on."""
        parts = []
        for row in rows:
            everything = (0.0, 0.0, self.images.shape[2], self.images.shape[1])
            parts.append(self._cut(int(row), everything, width, height))
        image, depth = (np.stack(part) for part in zip(*parts, strict=True))
        return Batch(np.stack([normalised(picture) for picture in image]), depth, self.shared(rows))

    def shared(self, rows: NDArray[np.int64]) -> F32:
        """Overlap (n, n) of views: the mean of both directions, 0 between worlds."""
        world = self.world[rows]
        same = world[:, None] == world[None]
        local = np.array([row - self._first[int(w)] for row, w in zip(rows, world, strict=True)])
        one = self.overlap[rows[:, None], np.where(same, local[None], 0)].astype(np.float32) * same
        return np.asarray((one + one.T) / 2, dtype=np.float32)

    def close(self, rows: NDArray[np.int64]) -> F32:
        """Closeness (n, n) of views, 0 to 1: their overlap, less so the farther apart they were taken."""
        place = self.position[rows]
        apart = np.linalg.norm(place[:, None] - place[None], axis=2)
        return np.asarray(self.shared(rows) * np.exp(-0.5 * (apart / NEARBY) ** 2), dtype=np.float32)

    def spoilt(self, row: int, narrowest: float, *seed: int) -> F32:
        """One picture as training sees it, not mirrored."""
        return self._example(row, False, WIDTH, HEIGHT, narrowest, np.random.default_rng((*seed, row)))[0]

    def of_world(self, world: int) -> NDArray[np.int64]:
        """The rows of one world."""
        return np.flatnonzero(self.world == world)

    def check_worlds(self) -> None:
        """Raises ValueError where there are fewer worlds than a batch takes different ones."""
        if len(self._first) < WORLDS:
            raise ValueError(f"training takes {WORLDS} worlds or more, here are {len(self._first)}")

    def _choose(self, rng: np.random.Generator) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Rows of a batch, and which are mirrored: whole worlds, since a mirrored place is another place."""
        self.check_worlds()
        rows, flips, taken = [], [], set[int]()
        while len(taken) < WORLDS:
            world = int(self.world[rng.integers(self.pose_count)])
            if world in taken:
                continue
            taken.add(world)
            count = int(np.sum(self.world == world)) // 2
            pairs = rng.choice(count, PAIRS, replace=False)
            rows += [self._first[world] + 2 * int(pair) + k for pair in pairs for k in (0, 1)]
            flips += [bool(rng.random() < 0.5)] * (2 * PAIRS)
        return np.array(rows), np.array(flips)

    def _example(
        self, row: int, flip: bool, width: int, height: int, narrowest: float, rng: np.random.Generator
    ) -> tuple[F32, F32]:
        whole_h, whole_w = self.images.shape[1:3]
        aspect = _ASPECT * float(np.exp(np.clip(rng.normal(0.0, 0.12), -0.3, 0.3)))
        w = whole_w * float(rng.uniform(narrowest, 1.0))
        h = w / aspect
        w, h = w * min(1.0, whole_h / h), min(h, float(whole_h))
        # Near the middle: real lenses have their axis there.
        x, y = (0.5 * (a - b) * (1 + 0.6 * rng.uniform(-1, 1)) for a, b in ((whole_w, w), (whole_h, h)))
        picture, depth = self._cut(row, (x, y, w, h), width, height)
        picture = spoilt(picture, rng)
        if flip:
            picture, depth = picture[:, ::-1], depth[:, ::-1]
        return normalised(picture), np.ascontiguousarray(depth)

    def _cut(
        self, row: int, part: tuple[float, float, float, float], width: int, height: int
    ) -> tuple[U8, F32]:
        """A part (x, y, w, h) of a view at another size, and its focal-normalised depth at half of that.

        The canonical focal length goes with the size, so that one network learns at several sizes.
        """
        x, y, w, h = part
        picture = resample(self.images[row], x, y, w, h, width, height, cv2.INTER_LINEAR)
        stored = np.asarray(self.depths[row], dtype=np.float32)
        scale = stored.shape[1] / self.images.shape[2]
        half = (width // 2, height // 2)
        depth = resample(stored, x * scale, y * scale, w * scale, h * scale, *half, cv2.INTER_NEAREST)
        focal = float(self.focal[row]) * np.sqrt(width / w * height / h)
        canonical = CANONICAL_FOCAL * np.sqrt(width / WIDTH * height / HEIGHT)
        usable = (depth > 0) & (depth < FARTHEST)
        return picture, np.where(usable, depth * np.float32(canonical / focal), np.float32(0))


def resample(
    image: NDArray, x: float, y: float, w: float, h: float, width: int, height: int, how: int
) -> NDArray:
    """The part (x, y, w, h) of an image, ``width`` x ``height`` pixels large; smoothed if it shrinks."""
    if how == cv2.INTER_LINEAR and w > 1.3 * width:
        image = cv2.blur(np.asarray(image), (2, 2))
    sx, sy = w / width, h / height
    to_image = np.array([[sx, 0, x + 0.5 * sx - 0.5], [0, sy, y + 0.5 * sy - 0.5]])
    flags = how | cv2.WARP_INVERSE_MAP
    return cv2.warpAffine(np.asarray(image), to_image, (width, height), None, flags, cv2.BORDER_REPLICATE)


def normalised(picture: U8) -> F32:
    """(h, w, 3) uint8 RGB to the network's (3, h, w)."""
    mean, std = np.array(MEAN, np.float32) * 255, np.array(STD, np.float32) * 255
    return np.ascontiguousarray(((picture - mean) / std).transpose(2, 0, 1), dtype=np.float32)


def spoilt(picture: U8, rng: np.random.Generator) -> U8:
    """Another light, lens, sensor and codec."""
    height, width = picture.shape[:2]
    fine = width / 224  # blur is in pixels of a picture of that width
    # Colours, contrast and level in one matrix: grey + colourful * (c - grey), times gains, about the mean.
    colourful = 0.0 if rng.random() < 0.12 else float(rng.uniform(0.3, 1.2))
    mix = colourful * np.eye(3) + (1 - colourful) * np.tile([0.299, 0.587, 0.114], (3, 1))
    mix *= np.exp(rng.normal(0.0, 0.12, (3, 1)))
    contrast, level = float(np.exp(rng.normal(0.0, 0.25))), float(rng.normal(0.0, 20.0))
    middle = mix @ np.array(cv2.mean(picture)[:3])
    out = cv2.transform(picture, np.hstack([contrast * mix, (middle * (1 - contrast) + level)[:, None]]))
    gamma = float(np.exp(rng.normal(0.0, 0.25)))
    out = cv2.LUT(out, (255.0 * (np.arange(256) / 255.0) ** gamma).astype(np.uint8))
    if rng.random() < 0.4:  # lamps and windows elsewhere than where they are
        field = rng.normal(0.0, 0.35, (int(rng.integers(2, 5)), int(rng.integers(2, 5)))).astype(np.float32)
        light = cv2.cvtColor(np.exp(cv2.resize(field, (width, height))), cv2.COLOR_GRAY2BGR)
        out = cv2.multiply(out, light, dtype=cv2.CV_8U)
    if rng.random() < 0.4:
        out = cv2.GaussianBlur(out, (0, 0), 0.3 + fine * float(rng.uniform(0.0, 1.0)))
    elif rng.random() < 0.3:
        length = 2 + round(fine * rng.integers(1, 6))
        out = cv2.filter2D(out, -1, streak(length, float(rng.uniform(0, np.pi))))
    elif rng.random() < 0.3:
        sharper = float(rng.uniform(0.3, 1.5))
        out = cv2.addWeighted(out, 1 + sharper, cv2.GaussianBlur(out, (0, 0), 1.0), -sharper, 0.0)
    y, x = rng.integers(0, _GRAIN.shape[0] - height), rng.integers(0, _GRAIN.shape[1] - width)
    grain = _GRAIN[y : y + height, x : x + width] * np.float32(fine * rng.uniform(0.0, 8.0))
    out = cv2.add(out, grain, dtype=cv2.CV_8U)
    if rng.random() < 0.25:
        quality = [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(25, 90))]
        out = cv2.imdecode(cv2.imencode(".jpg", out, quality)[1], cv2.IMREAD_COLOR)
    return np.asarray(out, dtype=np.uint8)


def streak(length: int, angle: float) -> F32:
    """The kernel of a motion over ``length`` pixels."""
    kernel = np.zeros((length, length), np.float32)
    middle = (length - 1) / 2
    reach = middle * np.array([np.cos(angle), np.sin(angle)])
    start, end = (np.rint(middle + sign * reach).astype(int).tolist() for sign in (-1, 1))
    cv2.line(kernel, start, end, 1.0)
    return kernel / kernel.sum()
