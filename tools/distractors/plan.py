"""Which objects, where and when: some keep ahead of the camera for a while, others walk past it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tools.distractors.recording import Recording, smoothed
from tools.distractors.solids import BOX, ELLIPSOID, Distractor, draw

Array = NDArray[np.float64]
MOST_COVERED = 0.4
SMOOTH_S = 1.5  # the camera's path is smoothed over this before an object keeps ahead of it
MARGIN_S = 1.0  # objects are under way before the first frame and after the last
STEP_OF_PLAN = 6  # coverage is planned on every so many frames, at every 8th pixel


def plan(recording: Recording, seed: int, coverage: float) -> list[Distractor]:
    """Objects for the whole recording, of sizes that cover the wished share of the image on average."""
    rng = np.random.default_rng(seed)
    times = recording.stamps
    first, last = times[0] - MARGIN_S, times[-1] + MARGIN_S
    smooth = smoothed(times, recording.poses, SMOOTH_S)
    # The image's vertical, on average, is the world's.
    up = -np.mean(recording.poses[:, :3, 1], axis=0)
    up /= np.linalg.norm(up)
    things: list[Distractor] = []
    now = first
    while now < last:  # one that keeps ahead, nearly always
        span = rng.uniform(5.0, 9.0)
        things.append(_follower(rng, recording, smooth, up, now, now + span))
        now += span - 1.0
    now = first
    while now < last:  # others walk past
        span = rng.uniform(2.0, 4.0)
        things.append(_passer(rng, recording, up, now, now + span))
        now += span * rng.uniform(0.5, 1.0)
    return _sized(recording, things, coverage)


def _distance(recording: Recording, index: int, rng: np.random.Generator) -> float:
    """Some way towards the surfaces in the middle of the image."""
    depth = recording.depth(index, 8)
    height, width = depth.shape
    middle = depth[height // 4 : 3 * height // 4, width // 4 : 3 * width // 4]
    known = middle[np.isfinite(middle)]
    return float(rng.uniform(0.5, 0.75) * (np.median(known) if len(known) else 2.0))


def _solid(rng: np.random.Generator, distance: float) -> tuple[str, Array]:
    """Shape and half extents of something that fills a twelfth of a wide image."""
    width = distance * rng.uniform(0.14, 0.24)
    return str(rng.choice([BOX, ELLIPSOID])), width * np.array([1.0, rng.uniform(1.2, 2.0), 0.8])


def _follower(
    rng: np.random.Generator, recording: Recording, smooth: Array, up: Array, start: float, end: float
) -> Distractor:
    times = np.linspace(start, end, 60)
    frames = np.clip(np.searchsorted(recording.stamps, times), 0, len(smooth) - 1)
    distance = _distance(recording, int(frames[30]), rng)
    phase, period = rng.uniform(0, 2 * np.pi), rng.uniform(2.5, 5.0)
    sway = rng.uniform(0.15, 0.3) * distance * np.sin(phase + 2 * np.pi * times / period)
    # It comes from one side and leaves to the other.
    entering = np.clip((1.2 - (times - start)) / 1.2, 0, 1) ** 2
    leaving = np.clip((1.2 - (end - times)) / 1.2, 0, 1) ** 2
    side = float(rng.choice([-1.0, 1.0]))
    x = sway + side * distance * (leaving - entering)
    y = np.full(len(times), rng.uniform(-0.1, 0.15) * distance)
    z = distance * (1.0 + 0.08 * np.sin(phase + 2 * np.pi * times / (1.7 * period)))
    local = np.stack([x, y, z, np.ones(len(times))], axis=1)
    points = np.einsum("ijk,ik->ij", smooth[frames], local)[:, :3]
    shape, half = _solid(rng, distance)
    return Distractor(shape, half, int(rng.integers(1 << 30)), start, end, points, rng.uniform(-0.3, 0.3), up)


def _passer(
    rng: np.random.Generator, recording: Recording, up: Array, start: float, end: float
) -> Distractor:
    """Straight across the image, past where the camera is half way."""
    frame = int(np.clip(np.searchsorted(recording.stamps, 0.5 * (start + end)), 0, len(recording.poses) - 1))
    distance = _distance(recording, frame, rng)
    side = float(rng.choice([-1.0, 1.0]))
    height = rng.uniform(-0.15, 0.2) * distance
    reach = distance * (0.55 * recording.camera.width / recording.camera.fx + 0.3)
    farther = distance * rng.uniform(0.8, 1.2)
    ends = np.array([[-side * reach, height, distance], [side * reach, height, farther]])
    points = ends @ recording.poses[frame, :3, :3].T + recording.poses[frame, :3, 3]
    shape, half = _solid(rng, distance)
    return Distractor(shape, half, int(rng.integers(1 << 30)), start, end, points, rng.uniform(-0.5, 0.5), up)


def _sized(recording: Recording, things: list[Distractor], coverage: float) -> list[Distractor]:
    """The objects, grown or shrunk until they cover what they should and nowhere more than they may."""
    frames = range(0, len(recording.stamps), max(STEP_OF_PLAN, len(recording.stamps) // 150))
    depths = {i: recording.depth(i, 8) for i in frames}

    def shares(of: list[Distractor]) -> dict[int, float]:
        return {i: float(np.isfinite(_covered(recording, i, of, depths[i])).mean()) for i in frames}

    for _ in range(4):
        mean = float(np.mean(list(shares(things).values())))
        factor = float(np.clip(np.sqrt(coverage / max(mean, 1e-3)), 0.6, 1.6))
        things = [replace(thing, half_extents=thing.half_extents * factor) for thing in things]
    for _ in range(12):
        full = [i for i, share in shares(things).items() if share > 0.95 * MOST_COVERED]
        if not full:
            break
        when = recording.stamps[full]
        for n, thing in enumerate(things):
            if ((when >= thing.start) & (when <= thing.end)).any():
                things[n] = replace(thing, half_extents=thing.half_extents * 0.92)
    return things


def _covered(recording: Recording, index: int, things: list[Distractor], depth: Array) -> Array:
    return draw(recording.camera, recording.poses[index], recording.stamps[index], things, depth, None, 8)[0]
