"""A recording that is a list of image files: what every dataset folder comes down to."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np

from prism_edge.errors import SourceError
from prism_edge.geometry.cameras import Camera
from prism_edge.messages import U8
from prism_edge.sources.base import DEFAULT_RATE_HZ, Image, Slot, Source, Unreadable
from prism_edge.sources.checks import check_camera_size
from prism_edge.sources.image_file import as_8_bits, ask_for, bits_used, read_pixels
from prism_edge.sources.listing import Listing
from prism_edge.sources.stamps import fits_ros, out_of_line, usual_period_ns, write_seconds

log = logging.getLogger("prism_edge.sources")

AHEAD = 15  # images: a disk may take a quarter of a second for one
_JUDGED = 8  # images all over the recording: one may be dark


class ImageSequence(Source):
    """Plays the images of a :class:`Listing`."""

    def __init__(self, folder: Path, listing: Listing, camera: Camera, camera_origin: str) -> None:
        self.name = f"{listing.layout} {folder} ({len(listing.files)} images)"
        self.camera = camera
        self.camera_origin = camera_origin
        self.frame_count = len(listing.files)
        self.period_ns = usual_period_ns(listing.stamps_ns, round(1e9 / DEFAULT_RATE_HZ))
        self._folder = folder
        self._listing = listing
        self._out_of_line, self._warned = out_of_line(listing.stamps_ns), False
        self._next = self._ahead = 0
        self._bits = 0  # of deeper pixels, once there are any; one range for all, or the light would flicker

    def open(self) -> None:
        """Raises SourceError where no image can be read, or has a stamp that can be published.

        ConfigError where they don't fit the camera.
        """
        self._next = self._ahead = 0
        stamps, reason = self._listing.stamps_ns, ""
        if not any(map(fits_ros, stamps)):
            first = write_seconds(stamps[0])
            raise SourceError(f"{self._folder}: no ROS message can hold its stamps, such as {first} s")
        if self._out_of_line and not self._warned:
            self._warned = True  # it is opened again for each round of a loop
            words = "%s: stamps that can't be right beside the others: %d, of image %d first; left out"
            log.warning(words, self._folder, len(self._out_of_line), min(self._out_of_line))
        for path in self._listing.files:
            pixels = self._read(path)
            if not isinstance(pixels, str):
                check_camera_size(self.camera, self.camera_origin, pixels, str(path))
                return
            reason = reason or f" ({pixels})"
        raise SourceError(f"{self._folder} has no readable image{reason}")

    def _read(self, path: Path) -> U8 | str:
        pixels = read_pixels(path)
        if not self._bits and not isinstance(pixels, str) and pixels.dtype == np.uint16:
            files = self._listing.files
            self._bits = bits_used([path, *files[:: max(1, len(files) // _JUDGED)]])
            words = "%s: its pixels use %d bits, of which the upper 8 are taken"
            log.warning(words, self._folder, self._bits)
        return as_8_bits(pixels, self._bits)

    def peek(self) -> Slot | None:
        if self._next >= len(self._listing.files):
            return None
        return Slot(self._next, self._listing.stamps_ns[self._next], self._next in self._out_of_line)

    def read(self) -> Image | Unreadable | None:
        slot = self.peek()
        if slot is None:
            return None
        self._next += 1
        if slot.out_of_line:
            stamp = write_seconds(slot.stamp_ns)
            reason = f"image {slot.index}: its stamp {stamp} s is out of line with the others"
            return Unreadable(slot.index, slot.stamp_ns, reason, out_of_line=True)
        pixels = self._read(self._listing.files[slot.index])
        if isinstance(pixels, str):
            return Unreadable(slot.index, slot.stamp_ns, pixels)
        return Image(slot.index, slot.stamp_ns, pixels)

    def skip(self) -> bool:
        self._next += 1
        return self._next <= len(self._listing.files)

    def read_ahead(self) -> None:
        self._ahead = max(self._ahead, self._next)
        for path in self._listing.files[self._ahead : self._next + AHEAD]:
            ask_for(path)
            self._ahead += 1

    def close(self) -> None:
        self._next = len(self._listing.files)
