"""The interface of every source: recordings now, cameras alike."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from dataclasses import dataclass
from types import TracebackType
from typing import Self

from prism_edge.geometry.cameras import Camera
from prism_edge.geometry.poses import Array
from prism_edge.messages import U8

# What a recording without stamps is taken to run at.
DEFAULT_RATE_HZ = 30.0


@dataclass(frozen=True)
class Image:
    """One image as it was read: grey (h, w) or BGR (h, w, 3)."""

    index: int  # in the recording, from 0
    stamp_ns: int  # capture, in the recording's or camera's own clock
    pixels: U8
    captured_monotonic_ns: int = 0  # the same on this host's monotonic clock; 0: a recording has none


@dataclass(frozen=True)
class Unreadable:
    """An image that should have been there: missing, truncated or no image at all; or one out of line."""

    index: int
    stamp_ns: int
    reason: str  # names the file
    out_of_line: bool = False  # its stamp can't be right beside the others'


@dataclass(frozen=True)
class Absent:
    """A live camera has no image at this moment, and may have one soon; why, its ``health`` says."""


@dataclass(frozen=True)
class Slot:
    """Where in a recording the next image stands."""

    index: int
    stamp_ns: int
    out_of_line: bool = False  # as of :class:`Unreadable`, which is what reading it gives


class Source(ABC):
    """A camera or recording: open, read until None, close; or a ``with`` block, which opens and closes.

    ``name`` is one line that says what it is; ``camera_origin`` says which intrinsics ``camera`` holds
    and where they are from. ``frame_count`` is None where nobody can know. ``period_ns`` is the usual
    time between images. A ``live`` source stamps images itself, its ``peek`` is always None, and its
    ``read`` comes back within a second, image or no image. A ``synthetic`` one has nothing that opening
    could find wrong, and ``peek`` answers before it is open. With one that ``decodes_skipped`` images,
    passing over an image costs about what reading it does.
    """

    name: str
    camera: Camera
    camera_origin: str
    frame_count: int | None
    period_ns: int
    live: bool = False
    synthetic: bool = False
    decodes_skipped: bool = False

    @abstractmethod
    def open(self) -> None:
        """Make ready to read; raises SourceError, or ConfigError where the camera can't be this one's."""

    @abstractmethod
    def peek(self) -> Slot | None:
        """The place of what :meth:`read` gives next, without decoding it; None at the end."""

    @abstractmethod
    def read(self) -> Image | Unreadable | Absent | None:
        """The next image, or why there is none in its place; None at the end. Only a live one is Absent."""

    @abstractmethod
    def skip(self) -> bool:
        """Pass over what :meth:`read` would give next, as cheaply as can be; False where that was the end."""

    def leap(self, index: int) -> int:
        """Pass over what lies before an index, as far as that costs nothing; how many images that were."""
        return 0

    @property
    def connecting_s(self) -> float:
        """How long opening may take beside the wait for a camera that isn't there."""
        return 0.0

    def stop_on(self, stopped: threading.Event) -> None:
        """Once that is set, opening waits no longer for a camera that isn't there."""
        return

    def read_ahead(self) -> None:
        """Before a wait for the next image: what follows may be brought nearer meanwhile."""
        return

    def true_pose(self, index: int) -> Array | None:
        """Exact world_from_camera (4, 4), metres, of an image that the source itself made; for scorers."""
        return None

    def health(self) -> dict[str, str]:
        """What a live source shows beside counts; a ``warning`` among it stands as long as its cause."""
        return {}

    @abstractmethod
    def close(self) -> None:
        """Give everything back; reading again takes another :meth:`open`."""

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
