"""The keyframes' pictures from a recording, and their depth from a network, for `prism-edge reconstruct`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import cv2

from prism_edge.cli.reconstruct_depth import Taken, depth_for
from prism_edge.config import Config
from prism_edge.errors import SourceError
from prism_edge.reconstruction.dense import Progress
from prism_edge.reconstruction.in_the_map import aligned, from_inverse
from prism_edge.reconstruction.look import Look, look
from prism_edge.reconstruction.viewpoints import Viewpoint
from prism_edge.sources import Image, Source, open_source

NO_PICTURE = "the recording has no picture of their time"
NO_DEPTH = "the network gives no depth"
NO_FIT = "the map has too few points there, or they contradict the network's depth"


@dataclass
class Gathered:
    """Looks by keyframe, and how many keyframes have none, by reason."""

    network: str
    dsug: tuple[float, float]
    is_measured: bool
    looks: dict[int, Look] = field(default_factory=dict)
    without: Counter[str] = field(default_factory=Counter)


def gather(config: Config, seen: Sequence[Viewpoint], width: int, progress: Progress) -> Gathered:
    """Every keyframe's look. Raises SourceError where the recording is not the map's, and ModelError."""
    depth, source = depth_for(config), open_source(config.source, calibrated=False)
    if source.live:
        raise SourceError(f"{source.name} is a camera, which has no past: give the recording of the map")
    gathered = Gathered(depth.name, depth.dsug, depth.is_measured)
    with source:
        answered = 0
        for taken, answer in depth.answers(_pictures(source, seen, progress)):
            answered += 1
            metres = answer.depth if answer.valid else None
            if metres is not None and depth.is_inverse:
                metres = from_inverse(metres, answer.image_to_depth, taken.viewpoint)
            if metres is not None:
                metres = aligned(metres, answer.image_to_depth, taken.viewpoint, depth.is_measured)
            if metres is None:
                gathered.without[NO_FIT if answer.valid else NO_DEPTH] += 1
                continue
            seen_so = taken.viewpoint, taken.rgb, metres, answer.confidence, answer.image_to_depth
            gathered.looks[taken.viewpoint.keyframe] = look(*seen_so, width)
    if not answered:
        raise SourceError(f"{source.name} has no picture of any keyframe: is it the recording of this map?")
    if answered < len(seen):
        gathered.without[NO_PICTURE] = len(seen) - answered
    return gathered


def _pictures(source: Source, seen: Sequence[Viewpoint], progress: Progress) -> Iterator[Taken]:
    """The keyframes' pictures, in the recording's order. Raises SourceError for one of another camera."""
    at = {view.stamp_ns: view for view in seen}
    done = 0
    while at and (slot := source.peek()) is not None:
        view = at.pop(slot.stamp_ns, None)
        if view is None:
            source.skip()
            continue
        progress("depth", done, len(seen))
        done += 1
        item = source.read()
        if isinstance(item, Image):
            shape = item.pixels.shape[:2]
            if shape != (view.camera.height, view.camera.width):
                raise SourceError(
                    f"{source.name} has pictures of {shape[1]}x{shape[0]}, but the map is of "
                    f"{view.camera.width}x{view.camera.height}"
                )
            code = cv2.COLOR_GRAY2RGB if item.pixels.ndim == 2 else cv2.COLOR_BGR2RGB
            yield Taken(view, item.index, cv2.cvtColor(item.pixels, code))
