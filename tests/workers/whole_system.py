"""The tracker worker on the film, answered by the real network check, scale estimate, gate and backend."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, is_dataclass, replace
from itertools import cycle

import numpy as np

from prism_edge.backend.mapper import Mapper
from prism_edge.bus import ros
from prism_edge.depth.prediction import Prediction, checked, no_confidence
from prism_edge.geometry.cameras import Camera
from prism_edge.messages import Depth, Frame, Keyframe, KeyframeImage
from prism_edge.scale.estimator import ScaleEstimator
from prism_edge.workers import tracker as worker
from prism_edge.workers.depth import answer
from tests.tracking.footage import IDENTITY, footage
from tests.workers.list_bus import ListBus
from tests.workers.tracker_bench import BASE_FROM_CAMERA, CONFIG, frame, inverse

PERIOD_NS = 100_000_000  # the film is played at 10 images a second, so that it is long enough to wait in
Spoil = Callable[[Prediction], Prediction | None]


def in_turn(*spoils: Spoil) -> Spoil:
    """One after the other, over and over."""
    turns = cycle(spoils)
    return lambda good: next(turns)(good)


class FilmNetwork:
    """Gives the film's true depth, with a descriptor; ``spoil`` may change it (None: no answer)."""

    name = identity = "film"
    bias_sigma, dsug, provider = 0.05, (0.17, 0.05), "none"

    def __init__(self, spoil: Spoil, bad: range, delay: int) -> None:
        self.counters: dict[str, int] = {}
        self.spoil, self.bad, self.delay, self.index = spoil, bad, delay, 0
        self.silent = False

    def infer(self, rgb: np.ndarray, camera: Camera) -> Prediction:
        film, at = footage(), film_index(self.index - self.delay)
        image = film.images[at]
        descriptor = (image[::40, ::40].astype(np.float32) - 100.0).ravel()
        good = Prediction(
            film.depths[at].astype(np.float32),
            IDENTITY,
            no_confidence(),
            descriptor,
            inference_ms=1.0,
        )
        given = self.spoil(good) if self.index in self.bad else good
        self.silent = given is None
        return checked(good if given is None else given)


class WholeSystem:
    """What hears the tracker: every keyframe gets depth, scale and a solved window before the next frame."""

    def __init__(
        self, spoil: Spoil = lambda good: good, bad: range = range(0), delay: int = 0
    ) -> None:
        """``bad`` are the frames whose depth is spoilt; its first image stands for ``delay`` frames."""
        self.delay = delay
        self.bus = ListBus("frame")
        self.bus.hear = self.heard
        self.network = FilmNetwork(spoil, bad, delay)
        self.estimator = ScaleEstimator(CONFIG.scale, (), CONFIG.gate)
        self.mapper = Mapper(CONFIG.backend)
        self.keyframes: dict[int, Keyframe] = {}
        self.scales: list[object] = []
        self.on_the_way: Callable[[Depth], Depth] = lambda said: said  # what a host that lends depth may do

    def heard(self, topic: str, message: object) -> None:
        if isinstance(message, Keyframe):
            self.keyframes[message.id] = message
        elif isinstance(message, KeyframeImage):
            self.network.index = message.index
            depth = self.on_the_way(answer(self.network, message))
            if not self.network.silent:
                self.bus.give("depth", depth)
            keyframe = self.keyframes.get(message.keyframe)
            if keyframe is not None:
                self.answered(keyframe, None if self.network.silent else depth)

    def answered(self, keyframe: Keyframe, depth: Depth | None) -> None:
        scaled = self.estimator.process(keyframe, depth)
        assert scaled is not None
        scale, gate = scaled
        self.scales.append(scale)
        self.bus.give("log_scale", scale)
        self.mapper.absorb(keyframe)
        self.mapper.add_gate(gate)
        if depth is not None:
            if depth.valid:
                self.mapper.add_depth(keyframe, depth, scale.log_scale)
            self.mapper.loops.add_place(keyframe.id, depth.descriptor)
        update = self.mapper.optimise(keyframe.id, scale.log_scale)
        closed = self.mapper.loops.look(keyframe.id)
        if closed is not None:
            update = self.mapper.whole(keyframe.id, self.mapper.loops.take_changes(), update, closed)
        if update is not None:
            self.bus.give("map_update", update)

    def play(self, count: int, change: Callable[[Frame], Frame] = lambda made: made) -> ListBus:
        """``count`` frames of the film, there and back; each may be changed."""
        shown = [film_index(i - self.delay) for i in range(count)]
        film = [replace(frame(i, of), stamp_ns=i * PERIOD_NS) for i, of in enumerate(shown)]
        self.bus.give("frame", *(change(made) for made in film))
        worker.main(CONFIG, self.bus)
        return self.bus

    # -- what came of it --------------------------------------------------------------------------

    def errors(self) -> dict[int, float]:
        """Distance (m) of each published position from the truth, by frame."""
        film = footage()
        found = {}
        for message in self.bus.of("pose"):
            i = ros.stamp_ns(message) // PERIOD_NS
            true = BASE_FROM_CAMERA @ film.poses[film_index(i - self.delay)] @ inverse(BASE_FROM_CAMERA)
            place = ros.pose_matrix(message.pose.pose)[:3, 3]
            found[i] = float(np.linalg.norm(place - true[:3, 3]))
        return found

    def words(self) -> dict[int, str]:
        """The first word of `status`, by frame."""
        return {
            ros.stamp_ns(m) // PERIOD_NS: m.status[0].message.split()[0]
            for m in self.bus.of("status")
            if ros.stamp_ns(m) < 1000 * PERIOD_NS  # else said before the first frame, by the host's clock
        }

    def reasons(self) -> dict[int, str]:
        """What `status` says of the depth, by frame."""
        rows = {ros.stamp_ns(m) // PERIOD_NS: m.status[0] for m in self.bus.of("status")}
        return {i: next(v.value for v in row.values if v.key == "depth") for i, row in rows.items()}


def film_index(i: int) -> int:
    """Where in the film frame ``i`` is: it goes there and back without end."""
    i = max(i, 0)
    last = len(footage().images) - 1
    return last - abs(last - i % (2 * last))


def numbers_of(message: object) -> list[np.ndarray]:
    """Every floating-point number of a message, however deep."""
    if is_dataclass(message):
        return [n for f in fields(message) for n in numbers_of(getattr(message, f.name))]
    if isinstance(message, (list, tuple)):
        return [n for item in message for n in numbers_of(item)]
    if isinstance(message, float):
        return [np.array([message])]
    if isinstance(message, np.ndarray) and message.dtype.kind == "f":
        return [message.ravel()]
    return []


def finite(bus: ListBus) -> bool:
    """Whether all that subscribers get is finite (`scale` says nan for an observation that there is not)."""
    public = [m for topic in ("odom", "pose", "tf", "status") for m in bus.of(topic)]
    return all(np.isfinite(n).all() for m in public for n in numbers_of(m))
