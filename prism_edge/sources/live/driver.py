"""What a kind of live camera has to offer: connect, grab, decode, close."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from prism_edge.errors import ConfigError
from prism_edge.geometry.cameras import Camera
from prism_edge.messages import U8


class CameraLostError(Exception):
    """The camera isn't there, or is no longer; it may come back."""


@dataclass(frozen=True)
class Grab:
    """One image as it came from the camera, not decoded yet: it may be passed over for a newer one."""

    captured_ns: int  # on this host's monotonic clock
    decode: Callable[[], U8 | str]  # grey (h, w) or BGR (h, w, 3), or why there is none
    missed: int = 0  # images the camera took since the last grab that never reached us


class Connection(Protocol):
    """A camera from the moment it is there until it is lost. One thread uses it."""

    @property
    def intrinsics(self) -> Camera | None:
        """What the camera itself knows of its intrinsics, None where it knows nothing.

        Raises SourceError where it knows what can't be used; whoever has others need not ask.
        """

    def grab(self) -> Grab | None:
        """The next image; None where none came within half a second or so. Raises CameraLostError."""

    def close(self) -> None:
        """Let go of the camera; raises nothing."""


class Driver(Protocol):
    """A kind of camera at one address."""

    name: str  # without passwords
    period_ns: int  # between images, as far as it is known
    dead_s: float  # a connection without an image for this long is given up
    connect_s: float  # an attempt takes no longer, whatever the camera does

    def connect(self) -> Connection:
        """Raises CameraLostError where it isn't there, SourceError where it is but can't be used."""


def size_for(width: int, height: int, camera: Camera | None, uri: str) -> tuple[int, int]:
    """Width and height of the images to ask for: those that the address says, or that a camera file is for.

    0 and 0 where neither says any. Raises ConfigError where they contradict one another.
    """
    if camera is None:
        return width, height
    if width and (width, height) != (camera.width, camera.height):
        raise ConfigError(
            f"{uri} asks for {width}x{height}, but the camera file is for "
            f"{camera.width}x{camera.height}; leave width and height out"
        )
    return camera.width, camera.height
