"""Listening to a running daemon: an ordinary subscriber that keeps what it hears."""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

from prism_edge.bus import ros
from prism_edge.bus.session import Bus
from prism_edge.config import FramesConfig
from prism_edge.evaluation.recording import Published, Recording
from prism_edge.evaluation.trajectory import tum_line
from prism_edge.geometry.mount import base_from_camera
from prism_edge.geometry.poses import Array
from prism_edge.messages import EndOfStream, Heartbeat, Tracked

log = logging.getLogger("prism_edge.evaluation")

_QUEUE = 4096  # messages; minutes of poses, so that a busy machine loses none
_LOOK_S = 0.2
_MOUNT_S = 0.5  # for an answer to where the camera sits
_ASKS = 4


def camera_pose(message: Any, mount: Array) -> tuple[int, Array]:
    """Stamp (ns) and map_from_camera (4, 4) of a geometry_msgs/PoseWithCovarianceStamped.

    The message holds map_from_base_link; ``mount`` is base_from_camera. Values that are not finite stay so.
    """
    with np.errstate(invalid="ignore", divide="ignore"):  # what is not finite is for the caller to judge
        return ros.stamp_ns(message), ros.pose_matrix(message.pose.pose) @ mount


def published_mount(bus: Bus, frames: FramesConfig) -> Array:
    """base_from_camera (4, 4) of the daemon whose poses come, as its `tf` says; in metres.

    That of ``frames``, with a warning, where the daemon doesn't say.
    """
    for _ in range(_ASKS):  # `tf` follows the first pose at once, but does follow it
        tree = bus.ask("tf", _MOUNT_S)
        links = [] if tree is None else tree.transforms
        parents = {link.header.frame_id for link in links}
        leaves = [link for link in links if link.child_frame_id not in parents]
        if len(leaves) == 1 and leaves[0].header.frame_id in {link.child_frame_id for link in links}:
            mount = ros.pose_matrix(leaves[0].transform)
            if np.isfinite(mount).all():
                return mount
    log.warning(
        "the daemon's tf does not say where the camera sits on the robot: frames.base_from_camera of this "
        "configuration is taken"
    )
    return base_from_camera(frames)


class PoseRecorder:
    """Appends each `pose` message to a TUM file at once, as the camera's pose; what was written stays."""

    def __init__(self, path: Path, mount: Callable[[], Array], append: bool = False) -> None:
        """Creates or empties the file, or goes on behind what is there where told to ``append``.

        ``mount`` gives base_from_camera (4, 4), asked at the first pose.
        Raises OSError with the file's name, as all that writes to it.
        """
        self.count = 0
        self._ask: Callable[[], Array] | None = mount
        self._mount, self._path = np.eye(4), path
        self._is_new = not (path.exists() or path.is_symlink())
        self._file = path.open("a" if append else "w", buffering=1)

    def record(self, message: Any) -> None:
        """One geometry_msgs/PoseWithCovarianceStamped; one that is not finite is left out."""
        if self._ask is not None:
            self._mount, self._ask = self._ask(), None
        stamp_ns, pose = camera_pose(message, self._mount)
        if np.isfinite(pose).all():
            with self._named():
                self._file.write(tum_line(stamp_ns, pose))
            self.count += 1

    def close(self) -> None:
        """Ends the file; a new one that no pose came for goes, or its name would be taken the next time."""
        with self._named():
            self._file.close()
            if self._is_new and not self.count:
                self._path.unlink(missing_ok=True)

    @contextlib.contextmanager
    def _named(self) -> Iterator[None]:
        """A full disk does not say of which file."""
        try:
            yield
        except OSError as error:
            raise OSError(error.errno, error.strerror, str(self._path)) from None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class Recorder:
    """Collects a run from the bus: poses and frames by threads of their own, the rest by :meth:`poll`.

    Subscribes at once. Poses are stamped when they come out of the subscription and decoded there;
    nothing else is done until the run is over, so that listening costs the machine little.
    """

    def __init__(self, bus: Bus, frames: FramesConfig) -> None:
        self._mount = base_from_camera(frames)
        self._recording = Recording()
        self._end: EndOfStream | None = None
        self._changed = threading.Event()
        self._closing = False
        self._stopped = bus.stopped
        self._scale: Any | None = None
        self._bias_sigma: float | None = None
        self._ends, self._heartbeats, self._scales = map(bus.queue, ("end", "heartbeat", "scale"))
        self._log_scales = bus.queue("log_scale")
        self._solved = bus.queue("solved")
        self._threads = [
            threading.Thread(
                target=self._listen, args=(bus.queue(topic, _QUEUE), keep), name="recorder", daemon=True
            )
            for topic, keep in (("pose", self._pose), ("tracked", self._tracked))
        ]
        for thread in self._threads:
            thread.start()

    def poll(self) -> list[Heartbeat]:
        """Takes what has come on the slow topics; returns the heartbeats."""
        for end in self._ends.drain():
            self._end = end
        for scale in self._scales.drain():
            self._scale = scale
        for log_scale in self._log_scales.drain():
            self._bias_sigma = log_scale.bias_sigma
        self._recording.solved.extend(self._solved.drain())
        beats: list[Heartbeat] = self._heartbeats.drain()
        return beats

    def wait(self, timeout_s: float) -> None:
        """Returns when a frame has been tracked, or after ``timeout_s``."""
        self._changed.wait(timeout_s)
        self._changed.clear()

    @property
    def frames(self) -> int:
        """Frames heard of so far."""
        return len(self._recording.arrivals_ns)

    @property
    def position(self) -> int:
        """Frames of the recording that are behind us, dropped ones included."""
        frames = self._recording.frames
        return frames[-1].index + 1 if frames else 0

    @property
    def ended(self) -> EndOfStream | None:
        """The source's farewell, once it has come."""
        return self._end

    @property
    def complete(self) -> bool:
        """Whether the source has ended and its last frame has been tracked."""
        return self._end is not None and self.position > self._end.last_index

    def close(self) -> Recording:
        """Stops listening and returns everything heard. What comes after the bus has closed is lost."""
        self._closing = True
        for thread in self._threads:
            thread.join()
        self.poll()
        heard = self._recording
        return Recording(
            heard.poses,
            heard.frames,
            heard.arrivals_ns,
            self._end,
            self._scale,
            self._bias_sigma,
            heard.solved,
        )

    def _listen(self, inbox: Any, keep: Any) -> None:
        while True:
            message = inbox.take(_LOOK_S)
            if message is not None:
                keep(message, time.monotonic_ns())
            elif self._closing or self._stopped.is_set():
                return

    def _pose(self, message: Any, arrival_ns: int) -> None:
        stamp_ns, pose = camera_pose(message, self._mount)
        covariance = np.asarray(message.pose.covariance, np.float64).reshape(6, 6)
        self._recording.poses.append(Published(stamp_ns, arrival_ns, pose, covariance))

    def _tracked(self, message: Tracked, arrival_ns: int) -> None:
        self._recording.frames.append(message)
        self._recording.arrivals_ns.append(arrival_ns)
        self._changed.set()
