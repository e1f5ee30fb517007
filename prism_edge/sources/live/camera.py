"""Any live camera as a source: a thread keeps the newest image and reconnects; reading never blocks."""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from dataclasses import dataclass

from prism_edge.errors import ConfigError, SourceError
from prism_edge.geometry.cameras import Camera
from prism_edge.messages import U8
from prism_edge.sources.base import Absent, Image, Slot, Source, Unreadable
from prism_edge.sources.checks import UNCALIBRATED, check_camera_size
from prism_edge.sources.live.driver import CameraLostError, Connection, Driver, Grab
from prism_edge.sources.live.picture_watch import PictureWatch
from prism_edge.sources.live.wall_clock import WallClock
from prism_edge.sources.native_stderr import native_stderr_unheard
from prism_edge.vital import vital

log = logging.getLogger("prism_edge.sources")

STREAMING, RECONNECTING = "streaming", "reconnecting"
# For the thread to come back from a driver. A process that is to end has supervisor.stop_s for all that ends.
_CLOSING_S, _LEAVING_S = 2.0, 0.5


@dataclass(frozen=True)
class Timing:
    """How long what is waited for (seconds)."""

    absent_s: float = 10.0  # a camera that isn't there, or gives no image, when opening
    first_pause_s: float = 0.25  # before connecting again; doubles with each attempt
    longest_pause_s: float = 1.0  # poses are missed no longer than that once the camera is back
    hang_s: float = 60.0  # a driver that doesn't come back for this long hangs for good
    read_s: float = 0.5


class LiveCamera(Source):
    """Reads the newest image of a camera and opens it again whenever it is lost.

    Stamps are the host's wall clock as it stood when this object was made, and go on evenly whatever
    happens to that clock later. Indices count what the camera took, so passed-over images show as gaps.
    """

    live = True

    def __init__(
        self, driver: Driver, camera: Camera | None, origin: str, timing: Timing | None = None
    ) -> None:
        """``camera`` may be None where the driver's connections have intrinsics of their own."""
        self.name = driver.name
        self.camera = camera or UNCALIBRATED
        self.camera_origin = origin
        self.frame_count = None
        self.period_ns = driver.period_ns
        self._driver, self._timing = driver, timing or Timing()
        self._asks_camera = camera is None
        self._wall_clock = WallClock()
        self._watch = PictureWatch()
        self._misfit = ""  # how the newest image's size is not the camera's
        self._quiet = ""  # for how long no image has come, where nobody says yet that it is lost
        self.stopped = threading.Event()  # set from outside, it ends the wait for a camera that isn't there
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None
        # Shared with the thread, under this lock:
        self._changed = threading.Condition()
        self._newest: tuple[int, Grab] | None = None
        self._taken = 0
        self._lost_why = ""
        self._reconnects = 0
        self._alive_s = self._image_s = 0.0  # last sign of life of the thread, and of the camera

    def stop_on(self, stopped: threading.Event) -> None:
        self.stopped = stopped

    @property
    def connecting_s(self) -> float:
        """How long one attempt may take, with the wait for its first image."""
        return self._driver.connect_s + self._driver.dead_s

    def open(self) -> None:
        """Connects and takes one image, then leaves the camera to a thread.

        Raises SourceError where no image comes within the patience, or the camera refuses what is asked of
        it, and ConfigError where its images don't fit the intrinsics.
        """
        self.close()
        self._closing.clear()
        connection = self._first_connection()
        self._alive_s = self._image_s = time.monotonic()
        self._thread = vital(self._run, "camera", (connection,))
        self._thread.start()

    def peek(self) -> Slot | None:
        """Always None: nobody knows a live image before it is there."""
        return None

    def read(self) -> Image | Unreadable | Absent:
        """The newest image not read yet, or after half a second without one, Absent.

        Raises SourceError where the camera's driver hangs: only a new process gets rid of that.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._newest is not None, self._timing.read_s)
            newest, self._newest = self._newest, None
        self._quiet = "" if newest else self._silence()
        if newest is None:
            return Absent()
        index, grab = newest
        stamp_ns = self._wall_clock.at(grab.captured_ns)
        pixels = _decoded(grab)
        if isinstance(pixels, str):
            self._watch.useless(pixels)
            return Unreadable(index, stamp_ns, f"image {index} of {self.name} {pixels}")
        self._watch.look(pixels, grab.captured_ns)
        self._misfit = self._compare(pixels)
        return Image(index, stamp_ns, pixels, grab.captured_ns)

    def skip(self) -> bool:
        """Forgets the newest image."""
        with self._changed:
            self._newest = None
        return True

    def health(self) -> dict[str, str]:
        """``camera`` (streaming, reconnecting and why, or how long no image has come), ``reconnects``, and
        ``warning`` where there is one."""
        with self._changed:
            why, reconnects = self._lost_why, self._reconnects
        state = f"{RECONNECTING}: {why}" if why else self._quiet or STREAMING
        values = {"camera": state, "reconnects": str(reconnects)}
        if why:
            warning = f"camera: {RECONNECTING} ({why})"
        elif self._quiet:
            warning = "camera: no image comes"
        else:
            warning = self._misfit or self._watch.problem
        return values | ({"warning": warning} if warning else {})

    def close(self) -> None:
        """Ends the thread, or leaves it behind where its driver hangs."""
        self._closing.set()
        if self._thread is not None:
            patience_s = _LEAVING_S if self.stopped.is_set() else _CLOSING_S
            self._thread.join(self._timing.read_s + patience_s)
            if self._thread.is_alive():
                log.warning("%s: the driver does not come back; it is left behind", self.name)
            self._thread = None
        self._newest = None

    def _first_connection(self) -> Connection:
        deadline = time.monotonic() + self._timing.absent_s
        told = False
        while True:
            try:
                return self._connected(deadline)
            except CameraLostError as error:
                left = deadline - time.monotonic()
                if left <= 0 or self.stopped.wait(min(left, self._timing.first_pause_s)):
                    raise SourceError(f"{self.name}: {error}") from None
                if not told:
                    log.warning("%s: %s; waiting up to %.0f s for it", self.name, error, left)
                told = True

    def _connected(self, deadline: float) -> Connection:
        """A connection that has given an image. Raises CameraLostError where there is none."""
        connection = self._driver.connect()
        try:
            if self._asks_camera:
                self.camera = self._own_intrinsics(connection)
            self.period_ns, self.name = self._driver.period_ns, self._driver.name
            self._check_first_image(connection, deadline)
        except BaseException:
            connection.close()
            raise
        return connection

    def _own_intrinsics(self, connection: Connection) -> Camera:
        intrinsics = connection.intrinsics
        if intrinsics is None:
            raise ConfigError(
                f"{self.name} knows nothing of its intrinsics: give a camera file (--camera FILE); "
                "prism-edge calibrate makes one"
            )
        return intrinsics

    def _check_first_image(self, connection: Connection, deadline: float) -> None:
        """Waits as long as the driver says, and where images come that can't be used, until ``deadline``."""
        reason = "no image came"
        end = time.monotonic() + self._patience_s
        tried = False  # at least once, however long we were kept from it
        while not tried or (time.monotonic() < end and not self.stopped.is_set()):
            tried = True
            try:
                grab = connection.grab()
            except CameraLostError as error:
                reason = str(error)
                break
            if grab is None:
                continue
            pixels = _decoded(grab)
            if not isinstance(pixels, str):
                check_camera_size(self.camera, self.camera_origin, pixels, self.name)
                return
            reason = pixels
            # The next key frame may be far off.
            end = max(end, min(time.monotonic() + self._patience_s, deadline))
        raise CameraLostError(f"it gives no image ({reason})")

    def _compare(self, pixels: U8) -> str:
        """A camera whose settings were changed while it was away is back, and nothing of it can be used."""
        height, width = pixels.shape[:2]
        wanted = self.camera.width, self.camera.height
        if self.camera is UNCALIBRATED or (width, height) == wanted:
            return ""
        return f"the camera sends {width}x{height}, its intrinsics are for {wanted[0]}x{wanted[1]}"

    def _silence(self) -> str:
        """For how long no image has come, empty where it is too early to worry.

        Raises SourceError where the camera's driver hangs.
        """
        now = time.monotonic()
        with self._changed:
            quiet_s, silent_s = now - self._image_s, now - self._alive_s
        if silent_s > self._timing.hang_s + self.connecting_s:
            raise SourceError(f"{self.name}: the driver has not come back for {silent_s:.0f} s")
        return f"no image for {quiet_s:.0f} s" if quiet_s > self._patience_s + 1.0 else ""

    @property
    def _patience_s(self) -> float:
        """Without an image, until the camera counts as lost."""
        return max(self._driver.dead_s, 3e-9 * self.period_ns)

    # What follows runs in the camera's thread.

    def _run(self, connection: Connection | None) -> None:
        pause_s = self._timing.first_pause_s
        while not self._closing.is_set():
            self._alive_s = time.monotonic()
            try:
                if connection is None:
                    connection = self._driver.connect()
                    self._alive_s = self._image_s = time.monotonic()  # the new connection's time begins here
                grab = connection.grab()
                if grab is not None:
                    self._put(grab)
                    pause_s = self._timing.first_pause_s
                    continue
                quiet_s = time.monotonic() - self._image_s
                if quiet_s <= self._patience_s:
                    continue
                why = f"no image for {quiet_s:.1f} s"
            except (CameraLostError, SourceError) as error:
                why = str(error)
            except MemoryError:  # a lock may be left held by it, for which reading waits
                raise
            except Exception as error:  # a driver's library may raise anything; the camera must come back
                why = f"{type(error).__name__}: {error}"
            if connection is not None:
                connection.close()
                connection = None
            self._lose(why)
            if self._closing.wait(pause_s):
                break
            pause_s = min(2 * pause_s, self._timing.longest_pause_s)
        if connection is not None:
            with contextlib.suppress(Exception):
                connection.close()

    def _put(self, grab: Grab) -> None:
        with self._changed:
            back = bool(self._lost_why)
            self._lost_why = ""
            self._reconnects += back
            index = self._taken + grab.missed
            self._taken = index + 1
            self._newest = index, grab
            self._image_s = time.monotonic()
            self._changed.notify_all()
        if back:
            self._watch = PictureWatch()  # what came before says nothing any more
            log.info("%s: images come again", self.name)

    def _lose(self, why: str) -> None:
        with self._changed:
            self._alive_s = time.monotonic()
            first = not self._lost_why
            self._lost_why = why
            self._newest = None
        if first:
            log.warning("%s: lost (%s); connecting again until it is back", self.name, why)


def _decoded(grab: Grab) -> U8 | str:
    try:
        with native_stderr_unheard():
            return grab.decode()
    except Exception as error:  # a library may raise anything; it costs the image, not the process
        return f"can't be decoded ({' '.join(str(error).split()) or type(error).__name__})"
