"""A video file, through OpenCV's FFmpeg; a camera file must go with it."""

from __future__ import annotations

import logging
import os
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np

from prism_edge.errors import SourceError
from prism_edge.geometry.cameras import Camera
from prism_edge.sources.base import DEFAULT_RATE_HZ, Image, Slot, Source, Unreadable
from prism_edge.sources.checks import check_camera_size
from prism_edge.sources.mp4_index import lacks_index, shown_ns
from prism_edge.sources.stamps import usual_period_ns

log = logging.getLogger("prism_edge.sources")

# What is wrong with a file is said by us, in one line: FFmpeg and OpenCV would add theirs on stderr.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # read when the first file is opened
_QUIET = cv2.utils.logging.LOG_LEVEL_ERROR

NO_VIDEO = "is no video that can be read (and no folder of images)"
NO_INDEX = (
    "has no index (moov): it was cut off while it was being recorded or copied; record it as .mkv, which "
    "can be read as far as it goes, or have the index made anew by a tool for that"
)
INTERLACED = (
    "if a player shows more it is interlaced, of which OpenCV 5 gives nothing, without a word; make it "
    "progressive (ffmpeg -i IN -vf bwdif OUT)"
)
CUT_SHORT = "it is damaged or was cut short"

# OpenCV says the same of a packet that can't be decoded as of the end, but of the end again and at once.
_ENDED = 100  # times in a row
_EARLY = 0.9  # of the time that the container says
_LOOKED_AT = 15  # frames, for the usual time between them
_BACK = 2  # of their stamps; a single one may be where recordings were joined
_ALIKE = 0.1  # of the time between frames


class Video(Source):
    """Plays a video file with the stamps of its container; one without any (.h264), at ``rate_hz``.

    The stamp of a frame is known only once it has been taken from the container, so :meth:`peek` expects it
    one period after the last, or sooner where that one came sooner; the item read has the true one.
    """

    decodes_skipped = True  # each frame rests on those before it

    def __init__(self, path: Path, camera: Camera, camera_origin: str, rate_hz: float = 0.0) -> None:
        self.name = f"video {path}"
        self.camera = camera
        self.camera_origin = camera_origin
        self.frame_count = None
        self.period_ns = round(1e9 / DEFAULT_RATE_HZ)
        self._path = path
        self._rate_hz = rate_hz
        self._capture: cv2.VideoCapture | None = None
        self._next = 0
        self._last_stamp_ns = self._last_step_ns = 0
        self._coming: list[bool] = []  # taken from the container already; False: could not be decoded
        self._decoded = False  # the one taken last
        self._known = False
        self._shuffled = False  # its stamps are of the order in which frames are stored, not shown
        self._said_ns = 0  # how long the container says it is; 0: it doesn't
        self._warned = False

    def open(self) -> None:
        """Raises SourceError where it is no video, ConfigError where its frames don't fit the camera."""
        capture = self._rewind()
        if not self._known:
            self._look(capture)
            self._rewind()

    def _look(self, capture: cv2.VideoCapture) -> None:
        """At its first frames: whether they fit, and when they come."""
        rate, count = capture.get(cv2.CAP_PROP_FPS), int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
        if 0.1 <= rate <= 1000.0:
            self.period_ns = round(1e9 / rate)
        self._said_ns = round(1e9 * count / rate) if count > 0 and rate > 0 else 0
        shown = shown_ns(self._path)
        if 0 < shown < self._said_ns:  # trimmed: what an edit list hides is counted, but not played
            count, self._said_ns = round(count * shown / self._said_ns), shown
        codec = int(capture.get(cv2.CAP_PROP_FOURCC)).to_bytes(4, "little", signed=True).decode("latin-1")
        image = next((item for item in iter(self.read, None) if isinstance(item, Image)), None)
        if image is None:
            why = f"it is damaged, or OpenCV does not decode {codec!r} here (then convert it, to H.264 say)"
            raise SourceError(f"{self._path} has no readable frame: {why}")
        check_camera_size(self.camera, self.camera_origin, image.pixels, str(self._path))
        if (1.0 - _EARLY) * count < capture.get(cv2.CAP_PROP_PTS) < count:
            count = self._said_ns = 0  # Matroska's goes by its last stamp, wherever the first one is
        stamps_ns, alike = [self._position_ns()], True
        while len(stamps_ns) < _LOOKED_AT and self._advance() is not None:
            stamps_ns.append(self._position_ns())
            alike = alike and np.array_equal(capture.retrieve()[1], image.pixels)
        if alike and len(stamps_ns) > 1:
            log.warning("%s begins with %d times one picture: %s", self._path, len(stamps_ns), INTERLACED)
        if stamps_ns[1:2] == [0]:
            if self._rate_hz:
                self.period_ns = round(1e9 / self._rate_hz)
            log.info("%s has no stamps: taken to run at %.4g Hz", self._path, 1e9 / self.period_ns)
        usual_ns = usual_period_ns(sorted(stamps_ns), self.period_ns)
        # Frames come as they are shown, so only a container that knows no such order has them go back often.
        self._shuffled = sum(b < a for a, b in pairwise(stamps_ns)) >= _BACK
        if not self._shuffled or abs(usual_ns / self.period_ns - 1.0) > _ALIKE:
            self.period_ns = usual_ns  # else the container's own, which is the mean over all its frames
        if self._shuffled:
            words = "%s has the stamps of frames as they are stored, not as shown: taken to run at %.4g Hz"
            log.warning(words, self._path, 1e9 / self.period_ns)
        # Where the container doesn't count its frames FFmpeg goes by a rate, guessed at that, say 1000 Hz.
        counted = shown > 0 or abs(self.period_ns * rate / 1e9 - 1.0) < _ALIKE
        self.frame_count = count if count > 0 and counted else None
        self._known = True

    def _rewind(self) -> cv2.VideoCapture:
        self.close()
        cv2.utils.logging.setLogLevel(_QUIET)
        # One decoding thread: the cores belong to the tracker.
        # From the root: FFmpeg takes what stands before a name's first colon for a protocol.
        file = os.path.abspath(self._path)
        capture = cv2.VideoCapture(file, cv2.CAP_FFMPEG, [cv2.CAP_PROP_N_THREADS, 1])
        if not capture.isOpened():
            raise SourceError(f"{self._path} {NO_INDEX if lacks_index(self._path) else NO_VIDEO}")
        capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)  # intrinsics belong to frames as stored
        turn = round(capture.get(cv2.CAP_PROP_ORIENTATION_META)) % 360
        if turn and not self._known:
            words = "%s asks to be turned by %d degrees; its frames are taken as they are stored"
            log.warning(f"{words}, and so must the camera file be", self._path, turn)
        self._capture = capture
        self._next, self._coming = 0, []
        self._last_stamp_ns, self._last_step_ns = -self.period_ns, self.period_ns
        return capture

    def peek(self) -> Slot | None:
        if self._capture is None:
            return None
        # A film may begin slowly, as in the dark: what is read a little early is held until it is due.
        step_ns = self._last_step_ns if 0 < self._last_step_ns < self.period_ns else self.period_ns
        return Slot(self._next, self._last_stamp_ns + step_ns)

    def read(self) -> Image | Unreadable | None:
        slot = self._advance()
        if slot is None or self._capture is None:
            return None
        readable, pixels = self._capture.retrieve() if self._decoded else (False, None)
        if not readable or pixels is None:
            return Unreadable(slot.index, slot.stamp_ns, f"{self._path}: frame {slot.index} is damaged")
        return Image(slot.index, slot.stamp_ns, pixels)

    def skip(self) -> bool:
        return self._advance() is not None

    def _advance(self) -> Slot | None:
        """Goes on to the next frame, or to where one could not be decoded; lets go of the file at its end."""
        if self._capture is None:
            return None
        if not self._coming:
            failed = next((k for k in range(_ENDED) if self._capture.grab()), None)
            if failed is None:
                self._end()
                return None
            self._coming = [False] * failed + [True]
        self._decoded = self._coming.pop(0)
        slot = Slot(self._next, self._stamp_ns())
        self._next += 1
        if self._decoded:
            self._last_step_ns = slot.stamp_ns - self._last_stamp_ns
            self._last_stamp_ns = slot.stamp_ns
        return slot

    def _end(self) -> None:
        self.close()
        reached_ns = self._last_stamp_ns + self.period_ns
        if 0 < reached_ns < _EARLY * self._said_ns and not self._warned:
            self._warned = True
            words = f"%s ends after %.1f s and should last %.1f s: {CUT_SHORT}"
            log.warning(words, self._path, reached_ns / 1e9, self._said_ns / 1e9)

    def _stamp_ns(self) -> int:
        """Of the frame taken last; about when it was where there is none."""
        position_ns = self._position_ns() if self._decoded and not self._shuffled else 0
        if position_ns == 0 and self._next > 0:  # in a bare stream, shuffled, and at an AVI's end
            return self._last_stamp_ns + self.period_ns
        return position_ns

    def _position_ns(self) -> int:
        """The stamp of the frame taken last, 0 where it has none."""
        return 0 if self._capture is None else round(self._capture.get(cv2.CAP_PROP_POS_MSEC) * 1e6)

    def close(self) -> None:
        if self._capture is not None:
            self._capture.release()
            self._capture = None
