"""What every image passes before it is released, and what is counted on the way (pure)."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from prism_edge.errors import ConfigError
from prism_edge.geometry.cameras import Camera
from prism_edge.messages import U8
from prism_edge.sources.base import Image, Slot, Unreadable
from prism_edge.sources.stamps import fits_ros

# Stands in where nobody needs intrinsics: whoever calibrates is about to find them.
UNCALIBRATED = Camera(1, 1, 1.0, 1.0, 0.0, 0.0)


def check_camera_size(camera: Camera, origin: str, pixels: U8, where: str) -> None:
    """Raises ConfigError where the first image has another size than the camera's.

    A camera is never scaled silently: whether an image was resized or cropped doesn't show.
    """
    height, width = pixels.shape[:2]
    if camera is not UNCALIBRATED and (width, height) != (camera.width, camera.height):
        raise ConfigError(
            f"the camera ({origin}) is for {camera.width}x{camera.height} images, but {where} is "
            f"{width}x{height}; give a camera file for that size"
        )


@dataclass
class Counts:
    """Totals of what a source has given so far."""

    frames: int = 0
    released: int = 0
    duplicates: int = 0
    unreadable: int = 0
    wrong_size: int = 0
    bad_stamps: int = 0
    skipped: int = 0  # passed over because the source itself was late

    @property
    def unusable(self) -> int:
        """Images that were there but could not be released."""
        return self.unreadable + self.wrong_size + self.bad_stamps


@dataclass(frozen=True)
class Verdict:
    """What becomes of one image; ``kind`` is one of the counters where it is refused."""

    released: bool
    duplicate: bool = False
    kind: str = ""
    reason: str = ""


@dataclass
class FrameChecks:
    """Looks at each item of a source in turn."""

    camera: Camera
    counts: Counts = field(default_factory=Counts)
    _stamp_ns: int | None = None  # of the last image released
    _pixels: U8 | None = None

    def bad_stamp(self, stamp_ns: int) -> str:
        """Why an image with this stamp will be refused for it, in a few words; empty where it won't."""
        if not fits_ros(stamp_ns):
            return "is beyond what a ROS message can hold"
        if self._stamp_ns is None or stamp_ns > self._stamp_ns:
            return ""
        return f"{'repeats' if stamp_ns == self._stamp_ns else 'goes back before'} the last one"

    def refuses(self, slot: Slot) -> bool:
        """Whether what stands there will be refused for its stamp: nothing can be timed by that."""
        return slot.out_of_line or bool(self.bad_stamp(slot.stamp_ns))

    def late(self) -> None:
        """An item was passed over unseen."""
        self.counts.frames += 1
        self.counts.skipped += 1

    def earlier(self, items: int) -> None:
        """So many items had their turn before this process was started again."""
        self.counts.frames += items

    def check(self, item: Image | Unreadable) -> Verdict:
        """Releases the item or says why not, and counts it.

        A duplicate is an exact copy, in all its pixels, of the image released before it.
        """
        self.counts.frames += 1
        if isinstance(item, Unreadable):
            self.counts.bad_stamps += item.out_of_line
            self.counts.unreadable += not item.out_of_line
            kind = "bad_stamps" if item.out_of_line else "unreadable"
            return Verdict(False, kind=kind, reason=item.reason)
        if why := self.bad_stamp(item.stamp_ns):
            self.counts.bad_stamps += 1
            stamp = f"{item.stamp_ns / 1e9:.6f} s"
            return Verdict(False, kind="bad_stamps", reason=f"image {item.index}: its stamp {stamp} {why}")
        height, width = item.pixels.shape[:2]
        if (width, height) != (self.camera.width, self.camera.height):
            self.counts.wrong_size += 1
            wanted = f"{self.camera.width}x{self.camera.height}"
            return Verdict(
                False, kind="wrong_size", reason=f"image {item.index} is {width}x{height} instead of {wanted}"
            )
        duplicate = self._pixels is not None and np.array_equal(item.pixels, self._pixels)
        self._stamp_ns, self._pixels = item.stamp_ns, item.pixels
        self.counts.released += 1
        self.counts.duplicates += duplicate
        return Verdict(True, duplicate)
