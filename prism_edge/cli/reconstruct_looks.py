"""The keyframes' pictures from a recording, and their depth from a network, for `prism-edge reconstruct`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cache

import cv2
import numpy as np

from prism_edge.cli.reconstruct_depth import Taken, depth_for
from prism_edge.config import Config
from prism_edge.depth.contract import INVERSE_RELATIVE
from prism_edge.errors import SourceError
from prism_edge.geometry.poses import Array
from prism_edge.messages import U8
from prism_edge.named_path import named_path
from prism_edge.reconstruction.dense import Progress
from prism_edge.reconstruction.in_the_map import aligned, from_relative, shown_in
from prism_edge.reconstruction.look import Look, look
from prism_edge.reconstruction.same_picture import is_picture_of
from prism_edge.reconstruction.viewpoints import Viewpoint
from prism_edge.sources import Image, Source, Unreadable, open_source
from prism_edge.sources.mask import Shown, mask_for
from prism_edge.tracking.features import OrbExtractor

NO_STAMPS = "if its images have no stamps, give the run's source.rate_hz; if it was looped, source.loop"
SHRUNK = "if the run made its images smaller, give its source.shrink"
NO_PICTURE = f"of whose time the recording has no picture: {NO_STAMPS}"
OTHER_PICTURE = "of whose time the recording's picture is another: the map may be of several recordings"
UNREADABLE = "whose picture can't be read"
NO_DEPTH = "of which the network gives no depth"
NO_FIT = "where the map has too few points, or they contradict the network's depth"


@dataclass
class Gathered:
    """Looks by keyframe, and how many keyframes have none, by reason."""

    network: str
    dsug: tuple[float, float]  # tau and T as its card has them; nan where they were not fitted
    is_measured: bool
    looks: dict[int, Look] = field(default_factory=dict)
    without: Counter[str] = field(default_factory=Counter)


def gather(
    config: Config, mount: Array, seen: Sequence[Viewpoint], width: int, progress: Progress
) -> Gathered:
    """Every keyframe's look; ``mount`` (4, 4) is base_from_camera of who made the map.

    Raises SourceError where the recording is not the map's, and ModelError.
    """
    # The camera is the map's: a robot's own file names one, which a simulated world would refuse.
    source = open_source(replace(config.source, camera=""), calibrated=False)
    if source.live:
        raise SourceError(f"{source.name} is a camera, which has no past: give the recording of the map")
    depth = depth_for(config, mount)
    gathered = Gathered(depth.name, depth.dsug, depth.is_measured)
    path, shrink = named_path(config.source.mask), config.source.shrink
    mask = cache(lambda width, height: mask_for(path, width, height, shrink, f": {SHRUNK}"))
    if config.source.mask and len({_size(view) for view in seen}) == 1:
        mask(*_size(seen[0]))  # said before the first depth; of several sizes the recording has one
    pictures = Pictures(config, seen, gathered.without, mask if config.source.mask else None)
    with source:
        for taken, answer in depth.answers(pictures.of(source, progress)):
            metres = answer.depth if answer.valid else None
            if metres is not None and depth.relative:
                is_inverse = depth.relative == INVERSE_RELATIVE
                metres = from_relative(metres, answer.image_to_depth, taken.viewpoint, is_inverse)
            if metres is not None:
                metres = aligned(metres, answer.image_to_depth, taken.viewpoint, depth.is_measured)
            if metres is None:
                gathered.without[NO_FIT if answer.valid else NO_DEPTH] += 1
                continue
            shown = mask(*_size(taken.viewpoint)) if config.source.mask else None
            if shown is not None:
                metres = np.where(shown_in(shown, metres.shape, answer.image_to_depth), metres, np.float32(0))
            seen_so = taken.viewpoint, taken.rgb, metres, answer.confidence, answer.image_to_depth
            gathered.looks[taken.viewpoint.keyframe] = look(*seen_so, width, shown)
    if not pictures.found:
        words = f"is it the recording of this map? And {NO_STAMPS}"
        raise SourceError(f"{source.name} has no picture of any keyframe: {words}")
    return gathered


class Pictures:
    """The keyframes' pictures; those that have none are counted in ``without``."""

    def __init__(
        self,
        config: Config,
        seen: Sequence[Viewpoint],
        without: Counter[str],
        mask: Callable[[int, int], Shown] | None = None,
    ) -> None:
        """``mask`` gives what of images (width, height) shows the world."""
        self.found = 0
        self._tracking, self._mask, self._is_looped = config.tracking, mask, config.source.loop
        self._extractors: dict[tuple[int, int], OrbExtractor] = {}
        self._seen, self._without = seen, without

    def of(self, source: Source, progress: Progress) -> Iterator[Taken]:
        """From an open source, in its order. Raises SourceError for a picture of no keyframe's size."""
        at: dict[int, list[Viewpoint]] = {}
        for view in self._seen:
            at.setdefault(view.stamp_ns, []).append(view)
        last = max(at, default=0)
        while at and (slot := source.peek()) is not None:
            if self._is_looped and slot.stamp_ns > last:  # it has no end of its own
                break
            # A video's next stamp is a guess before it is read, which skipping would hardly be cheaper than.
            if not source.decodes_skipped and slot.stamp_ns not in at:
                source.skip()
                continue
            item = source.read()
            views = at.pop(item.stamp_ns, []) if isinstance(item, Image | Unreadable) else []
            if not isinstance(item, Image):
                if views:  # or it would be said of 0 keyframes
                    self._without[UNREADABLE] += len(views)
                continue
            progress("depth", len(self._seen) - sum(map(len, at.values())) - len(views), len(self._seen))
            for view in views:
                self._check_size(source, item, view)
                yield from self._taken(view, item)
        if at:
            self._without[NO_PICTURE] += sum(map(len, at.values()))

    def _taken(self, view: Viewpoint, item: Image) -> Iterator[Taken]:
        """The picture as the keyframe's, if it is."""
        is_grey = item.pixels.ndim == 2
        grey = item.pixels if is_grey else cv2.cvtColor(item.pixels, cv2.COLOR_BGR2GRAY)
        if grey.shape[::-1] != _size(view) or not self._shows(view, grey):
            self._without[OTHER_PICTURE] += 1
            return
        self.found += 1
        code = cv2.COLOR_GRAY2RGB if is_grey else cv2.COLOR_BGR2RGB
        yield Taken(view, item.index, cv2.cvtColor(item.pixels, code))

    def _shows(self, view: Viewpoint, grey: U8) -> bool:
        extractor = self._extractors.get(_size(view))
        if extractor is None:
            extractor = self._extractors[_size(view)] = OrbExtractor(self._tracking)
            if self._mask is not None:
                extractor.look_only_at(self._mask(*_size(view)))
        return is_picture_of(extractor.extract(grey, view.camera), view.features, view.camera.height)

    def _check_size(self, source: Source, item: Image, view: Viewpoint) -> None:
        height, width = item.pixels.shape[:2]
        if (width, height) not in map(_size, self._seen):
            of = "{}x{}".format(*_size(view))
            words = f"{source.name} has pictures of {width}x{height}, but the map is of {of}"
            raise SourceError(f"{words}: {SHRUNK}" if width > view.camera.width else words)


def _size(view: Viewpoint) -> tuple[int, int]:
    return view.camera.width, view.camera.height
