"""A walk round a ring, as a tracker that drifts would tell of it: at the end it is back and doesn't know."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from prism_edge.geometry.alignment import align
from prism_edge.geometry.poses import Array, from_rt, inverse, se3_exp, transform
from prism_edge.messages import HOME, Keyframe
from prism_edge.tracking.features import Features
from tests.synthetic.messages import blank
from tests.tracking.cloud import CAMERA, descriptors, flipped

RADIUS, WALL = 3.0, (5.0, 8.0)
FORGOTTEN = 3  # keyframes without a point after which it is a new one


def looking_out(heading: float) -> Array:
    """world_from_camera on the ring, looking away from its middle; the world's y is down, like a camera's."""
    s, c = np.sin(heading), np.cos(heading)
    rotation = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    return from_rt(rotation, RADIUS * rotation[:, 2])


@dataclass
class Ring:
    """``lap`` keyframes a round. ``drift`` is a twist added to each step, ``stretch`` its factor of scale."""

    lap: int = 40
    drift: Array = field(default_factory=lambda: np.zeros(6))
    stretch: float = 1.0
    noise_px: float = 0.3
    seed: int = 0
    alike: bool = False  # the far side of the ring is an exact copy of the near one
    count: int = 3000

    def __post_init__(self) -> None:
        self.rng = np.random.default_rng(self.seed)
        heading = self.rng.uniform(0.0, 2.0 * np.pi, self.count)
        distance = self.rng.uniform(*WALL, self.count)
        height = self.rng.uniform(-2.0, 2.0, self.count)
        self.words = descriptors(self.rng, self.count)
        if self.alike:
            half = self.count // 2
            heading[:half] %= np.pi
            heading[half:], distance[half:] = heading[:half] + np.pi, distance[:half]
            height[half:], self.words[half:] = height[:half], self.words[:half]
        self.points = np.column_stack([np.sin(heading) * distance, height, np.cos(heading) * distance])
        self.true: list[Array] = []
        self.told: list[Array] = []
        self.part = HOME  # that the tracker has the next keyframes in
        self.unit = 1.0  # of the tracker, beside the true one
        self.ids: dict[int, tuple[int, int]] = {}  # point: identity, keyframe that saw it last
        self.positions: dict[int, Array] = {}  # identity: where the tracker has it
        self.point_of: dict[int, int] = {}

    def keyframes(self, count: int) -> list[Keyframe]:
        """The next so many keyframes."""
        return [self.keyframe() for _ in range(count)]

    def keyframe(self, at: Array | None = None) -> Keyframe:
        """The next keyframe, truly ``at`` a pose, else one step on."""
        number = len(self.true)
        true = looking_out(2.0 * np.pi * number / self.lap) if at is None else at
        told = true
        if self.told:
            step = inverse(self.true[-1]) @ true
            step[:3, 3] *= self.unit
            told = self.told[-1] @ step @ se3_exp(self.drift * self.unit)
            self.unit *= self.stretch
        self.true.append(true)
        self.told.append(told)
        local = transform(inverse(true), self.points)
        shown = np.flatnonzero(local[:, 2] > 0.5)
        pixels = CAMERA.project(local[shown])
        inside = np.all((pixels >= 0) & (pixels < (CAMERA.width, CAMERA.height)), axis=1)
        shown, pixels = shown[inside], pixels[inside]
        shown_pixels = pixels + self.rng.normal(0.0, 1.0, pixels.shape) * self.noise_px
        new = []
        for p in shown.tolist():
            identity, last = self.ids.get(p, (-1, -100))
            if number - last > FORGOTTEN:
                identity = len(self.positions)
                self.positions[identity] = transform(told, self.unit * local[p][None])[0]
                self.point_of[identity] = p
                new.append(identity)
            self.ids[p] = (identity, number)
        points = np.array([self.ids[p][0] for p in shown.tolist()], np.int64)
        words = flipped(self.rng, self.words[shown], 12)
        before = self.told[-2] if number else told
        return blank(
            Keyframe,
            id=number,
            index=10 * number,
            stamp_ns=number * 300_000_000,
            epoch=0,
            camera_model=CAMERA.model,
            camera=CAMERA.to_array(),
            world_from_camera=told,
            pixels=shown_pixels.astype(np.float32),
            octaves=np.zeros(len(shown), np.uint8),
            descriptors=words.view(np.uint8).reshape(-1, 32),
            points=points,
            depths=(self.unit * local[shown, 2]).astype(np.float32),
            parallax_deg=np.full(len(shown), 3.0, np.float32),
            new_points=np.array(new, np.int64),
            new_positions=np.array([self.positions[i] for i in new]).reshape(-1, 3),
            new_by=np.full(len(new), number),
            part=self.part,
            anchor=max(number - 1, 0),
            world_from_anchor=before,
            travelled=number * 2.0 * np.pi * RADIUS / self.lap,
        )

    def looks_like(self, number: int) -> np.ndarray:
        """What a network might say of a keyframe: soft bins of its heading, on a large common part."""
        heading = np.arctan2(self.true[number][0, 2], self.true[number][2, 2])
        if self.alike:
            heading *= 2.0
        bins = np.linspace(0.0, 2.0 * np.pi, 32, endpoint=False)
        return (3.0 + np.exp(4.0 * (np.cos(heading - bins) - 1.0))).astype(np.float32)


def features_of(message: Keyframe) -> Features:
    """The features in a keyframe message."""
    return Features.build(
        message.pixels.astype(np.float64),
        message.octaves.astype(np.intp),
        np.ascontiguousarray(message.descriptors).view(np.uint64).reshape(-1, 4),
        CAMERA.width,
        CAMERA.height,
    )


def position_error(poses: dict[int, Array], true: list[Array]) -> float:
    """Root mean square distance of camera centres after the best similarity."""
    ids = sorted(poses)
    found = np.array([poses[k][:3, 3] for k in ids])
    truth = np.array([true[k][:3, 3] for k in ids])
    fit = align(found, truth, with_scale=True)
    return float(np.sqrt(((fit.apply(found) - truth) ** 2).sum(axis=1).mean()))
