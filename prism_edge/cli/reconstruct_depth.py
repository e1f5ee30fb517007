"""Whom `prism-edge reconstruct` asks for depth: a network of one picture or several, or a depth camera."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from prism_edge.config import SENSOR, Config
from prism_edge.depth import DepthNetwork
from prism_edge.depth.offline import UnscaledNetwork, open_offline
from prism_edge.depth.prediction import Prediction
from prism_edge.depth.session import failing_in_a_line
from prism_edge.depth.several_views import SeveralViewsNetwork
from prism_edge.depth.straight import bent_back, set_straight, straight_camera
from prism_edge.depth.upright import UprightNetwork, camera_from_turned, turned_back, turned_camera
from prism_edge.errors import ModelError
from prism_edge.geometry.mount import quarter_turns
from prism_edge.geometry.poses import Array
from prism_edge.reconstruction.viewpoints import Viewpoint
from prism_edge.workers.sensor_network import SensorNetwork


@dataclass(frozen=True)
class Taken:
    """A keyframe's picture (height, width, 3) RGB, and its number in the recording."""

    viewpoint: Viewpoint
    index: int
    rgb: NDArray[np.uint8]


Answers = Callable[[Iterable[Taken]], Iterator[tuple[Taken, Prediction]]]


@dataclass(frozen=True)
class DepthOf:
    """Who answers, and how: pictures in, each one's depth out, in their order."""

    name: str
    dsug: tuple[float, float]  # the gate's tau and T as fitted for it; nan where they are not
    answers: Answers
    relative: str = ""  # the kind of depth that is known up to scale and shift; empty: up to scale at most
    is_measured: bool = False  # by a depth camera: pictures know no better


def depth_for(config: Config, mount: Array) -> DepthOf:
    """Who answers for ``depth.model``; networks see pictures upright where ``mount`` (4, 4) says so.

    Raises ModelError.
    """
    if config.depth.model == SENSOR:
        return _of_sensor(SensorNetwork(config.source))
    if not config.depth.network:
        raise ModelError("a cloud needs depth: --model names a network")
    network, turns = open_offline(config.depth.model, config.depth), quarter_turns(mount)
    if isinstance(network, SeveralViewsNetwork):
        return _of_several(network, turns)
    relative = network.kind if isinstance(network, UnscaledNetwork) else ""
    return _of_one(UprightNetwork(network, turns) if turns else network, relative)


def _of_sensor(sensor: SensorNetwork) -> DepthOf:
    def answers(pictures: Iterable[Taken]) -> Iterator[tuple[Taken, Prediction]]:
        for taken in pictures:
            yield taken, sensor.measure(taken.index, taken.viewpoint.camera)

    return DepthOf(sensor.name, sensor.dsug, answers, is_measured=True)


def _of_one(network: DepthNetwork, relative: str) -> DepthOf:
    """Bent pictures stay bent: straight ones show less, and a cloud lives by what it covers."""

    def answers(pictures: Iterable[Taken]) -> Iterator[tuple[Taken, Prediction]]:
        for taken in pictures:
            with failing_in_a_line(network.name):
                answer = network.infer(taken.rgb, taken.viewpoint.camera)
            yield taken, answer

    return DepthOf(f"{network.name} ({network.provider})", network.dsug, answers, relative)


def _of_several(network: SeveralViewsNetwork, turns: int) -> DepthOf:
    """Keyframes that follow each other go together; those left at the end, with the ones before them.

    Their geometry is told by matrices, so pictures of strongly bent lenses are set straight.
    """

    def infer(together: Iterable[Taken]) -> list[tuple[Taken, Prediction]]:
        taken = list(together)
        cameras = [t.viewpoint.camera for t in taken]
        poses = np.array([t.viewpoint.map_from_camera for t in taken])
        straight = [straight_camera(camera) for camera in cameras]
        both = list(zip(cameras, straight, strict=True))
        pictures = [set_straight(t.rgb, *pair) for t, pair in zip(taken, both, strict=True)]
        upright = [np.ascontiguousarray(np.rot90(rgb, turns)) for rgb in pictures]
        turned = [turned_camera(camera, turns) for camera in straight]
        found = network.infer(upright, turned, poses @ camera_from_turned(turns))
        back = [
            bent_back(turned_back(answer, turns, seen), camera, seen)
            for answer, (camera, seen) in zip(found, both, strict=True)
        ]
        return list(zip(taken, back, strict=True))

    def answers(pictures: Iterable[Taken]) -> Iterator[tuple[Taken, Prediction]]:
        last: deque[Taken] = deque(maxlen=network.views)
        waiting = 0
        for taken in pictures:
            last.append(taken)
            waiting += 1
            if waiting == network.views:
                yield from infer(last)
                waiting = 0
        if last and len(last) < network.views:
            raise ModelError(
                f"{network.name} takes {network.views} keyframes at once, and {len(last)} have a picture"
            )
        if waiting:
            yield from infer(last)[-waiting:]

    return DepthOf(f"{network.name} ({network.provider})", network.dsug, answers)
