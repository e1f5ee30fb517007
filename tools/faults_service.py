"""The service under trial: a looping room, the daemon with a manager that starts it again, a subscriber."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import struct
import subprocess
import sys
import threading
import time
import uuid
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import psutil
import zenoh

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from prism_edge.bus import ros
from prism_edge.bus.session import Bus
from prism_edge.bus.vacancy import free_endpoint
from prism_edge.config import BusConfig, Config, DepthConfig, SourceConfig, StateConfig
from prism_edge.config_file import dump
from prism_edge.evaluation.resources import pss_mb
from prism_edge.geometry.poses import Array
from prism_edge.messages import Keyframe
from prism_edge.workers.launch import TITLE
from tests.synthetic.network import write_tiny_network
from tests.synthetic.sequence import write_sequence

ROOT = Path(__file__).resolve().parents[1]
MARK = "PRISM_EDGE_TRIAL"
RESTART_S = 0.2  # the unit's RestartSec


@dataclass(frozen=True)
class Room:
    """A generated room: JPEGs there and back, its camera, and a network that knows its depth."""

    folder: Path
    pictures: tuple[bytes, ...]
    camera: Path
    network: Path


def draw_room(folder: Path, frames: int = 120, width: int = 320, height: int = 240, seed: int = 0) -> Room:
    """Draws it; a loop through its pictures never jumps."""
    sequence = write_sequence(folder / "room", frames, width, height, seed)
    pictures = [cv2.imread(str(path)) for path in sorted((sequence / "rgb").iterdir())]
    encoded = [cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 98])[1].tobytes() for image in pictures]
    both_ways = tuple(encoded + encoded[-2:0:-1])
    return Room(sequence, both_ways, sequence / "camera.yaml", write_tiny_network(folder / "tiny.onnx"))


def long_recording(room: Room, folder: Path, frames: int = 1800) -> Path:
    """The room there and back as a recording at 30 Hz, for `source.loop`."""
    folder.mkdir()
    (folder / "rgb").symlink_to(room.folder / "rgb")
    names = [line.split()[1] for line in (room.folder / "rgb.txt").read_text().splitlines()[1:]]
    path = names + names[-2:0:-1]
    frames -= frames % len(path)  # ends where it began
    lines = [f"{i / 30:.6f} {path[i % len(path)]}\n" for i in range(frames)]
    (folder / "rgb.txt").write_text("".join(lines))
    return folder


class Service:
    """``prism-edge run``, started again whenever it ends, as systemd would; a context manager."""

    def __init__(self, folder: Path, config: Config, clock_library: Path | None = None) -> None:
        self.config, self.folder = config, folder
        self.log = folder / "daemon.log"
        self.mark = uuid.uuid4().hex
        self.clock = folder / "clock" if clock_library else None
        self.exits: list[int] = []
        runtime = folder / "runtime"
        runtime.mkdir()
        self._file = folder / "config.yaml"
        self._file.write_text(dump(config))
        threads = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        self._environment = {
            **os.environ, **threads, MARK: self.mark, "TMPDIR": str(runtime), "XDG_RUNTIME_DIR": str(runtime)
        }
        if self.clock is not None:
            self.step_clock(0)
            self._environment |= {"LD_PRELOAD": str(clock_library), "PRISM_EDGE_TRIAL_CLOCK": str(self.clock)}
        self._ending = threading.Event()
        self._popen = self._start()
        self._manager = threading.Thread(target=self._manage, name="manager", daemon=True)

    @property
    def pid(self) -> int:
        """The supervisor's."""
        return self._popen.pid

    def step_clock(self, seconds: int) -> None:
        """The wall clock, as the service sees it, is off by so much from now on."""
        assert self.clock is not None
        with self.clock.open("r+b" if self.clock.exists() else "w+b") as file:
            file.write(struct.pack("=q", seconds))

    def processes(self) -> dict[str, psutil.Process]:
        """Those that run, by name."""
        found: dict[str, psutil.Process] = {}
        with contextlib.suppress(psutil.Error):
            root = psutil.Process(self.pid)
            found["supervisor"] = root
            for child in root.children():
                with contextlib.suppress(psutil.Error):
                    title, _, name = child.cmdline()[0].partition(" ")
                    if title == TITLE:
                        found[name] = child
        return found

    def marked(self) -> list[psutil.Process]:
        """Every process that the service ever started and that still runs."""
        found = []
        for process in psutil.process_iter():
            with contextlib.suppress(psutil.Error):
                if process.environ().get(MARK) == self.mark and process.status() != psutil.STATUS_ZOMBIE:
                    found.append(process)
        return found

    def memory_mb(self, part: str = "") -> dict[str, float]:
        """PSS of each process, or a ``part`` of it."""
        return {name: pss_mb(p.pid, part) or 0.0 for name, p in self.processes().items()}

    def descriptors(self) -> dict[str, int]:
        """Open files of each process."""
        found = {}
        for name, process in self.processes().items():
            with contextlib.suppress(psutil.Error):
                found[name] = process.num_fds()
        return found

    def __enter__(self) -> Service:
        self._manager.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()
        for process in self.marked():
            with contextlib.suppress(psutil.Error):
                process.kill()

    def stop(self, timeout_s: float = 15.0) -> int | None:
        """SIGTERM; the exit code, None where it had to be killed."""
        self._ending.set()
        if self._manager.is_alive():
            self._manager.join()
        self._popen.terminate()
        try:
            return self._popen.wait(timeout_s)
        except subprocess.TimeoutExpired:
            self._popen.kill()
            self._popen.wait()
            return None

    def _start(self) -> subprocess.Popen[bytes]:
        line = [sys.executable, "-m", "prism_edge.cli", "run", "--config", str(self._file)]
        with self.log.open("ab") as output:
            return subprocess.Popen(
                line, cwd=ROOT, env=self._environment, stdin=subprocess.DEVNULL, stdout=output, stderr=output
            )

    def _manage(self) -> None:
        while not self._ending.wait(0.05):
            code = self._popen.poll()
            if code is not None:
                self.exits.append(code)
                if self._ending.wait(RESTART_S):
                    return
                self._popen = self._start()


def one_run(exits: list[int], code: int | None) -> tuple[str, bool]:
    """For a report: whether the service ran through and ended with 0 when it was told to.

    ``exits`` are those before: one that dies altogether is started anew, and all its counts with it.
    """
    before = f", and before that by itself with {', '.join(map(str, exits))}" if exits else ""
    return f"{code}{before}", code == 0 and not exits


def service_config(uri: str, room: Room, state: Path, **source: Any) -> Config:
    """The configuration of a trial: an endpoint of its own, a state directory of its own."""
    return Config(
        source=SourceConfig(uri=uri, camera=str(room.camera), **source),
        bus=BusConfig(free_endpoint(), retry_ms=100),
        depth=DepthConfig(model=str(room.network)),
        state=StateConfig(directory=str(state)),
    )


class Watcher:
    """An ordinary subscriber: when each pose came, whether it was a number, and what `health` says."""

    def __init__(self, config: Config) -> None:
        self.poses: list[float] = []  # arrival, monotonic seconds
        self.path: list[tuple[float, Array]] = []  # stamp in seconds, world_from_camera
        self.far_poses: list[float] = []  # arrivals behind a router
        self.not_numbers = 0
        self.latencies: list[tuple[float, float]] = []  # arrival, milliseconds from capture
        self.odometry = ""
        self.epoch = 0
        self.health: dict[str, dict[str, str]] = {}
        self._over = threading.Event()
        self.bus = Bus.open(replace(config, mode="realtime"), "trial")
        names = ("pose", "tracked", "health", "keyframe")
        self._inboxes = {name: self.bus.queue(name, 4096) for name in names}
        self._threads = [threading.Thread(target=self._listen, args=(n,), daemon=True) for n in self._inboxes]
        for thread in self._threads:
            thread.start()

    def keyframes(self) -> int:
        """In the backend's map, -1 where it does not answer."""
        snapshot = self.bus.ask("map_snapshot", 2.0)
        return -1 if snapshot is None else len(snapshot.keyframes)

    @property
    def well(self) -> bool:
        """Whether poses flow (ten in the last second), and no row of `health` is in error."""
        recent = self.poses[-10:]
        flows = len(recent) == 10 and recent[0] > time.monotonic() - 1.5
        return flows and bool(self.health) and all(row["level"] in "01" for row in self.health.values())

    def longest_gap(self, begin: float, end: float, poses: list[float] | None = None) -> float:
        """Seconds without a pose between the last before ``begin`` and ``end``."""
        return self.longest_gap_and_when(begin, end, poses)[0]

    def longest_gap_and_when(
        self, begin: float, end: float, poses: list[float] | None = None
    ) -> tuple[float, float]:
        """As :meth:`longest_gap`, and the time at which it began."""
        times = list(self.poses if poses is None else poses)
        first = max((i for i, at in enumerate(times) if at <= begin), default=0)
        inside = [*[at for at in times[first:] if at <= end], end]
        if len(inside) < 2:
            return end - begin, begin
        gaps = np.diff(inside)
        return float(gaps.max()), inside[int(gaps.argmax())]

    def close(self) -> None:
        """Listen no more."""
        self._over.set()
        for thread in self._threads:
            thread.join(2.0)
        self.bus.close()

    def _listen(self, name: str) -> None:
        inbox = self._inboxes[name]
        while not self._over.is_set():
            message = inbox.take(0.2)
            if message is None:
                continue
            now = time.monotonic()
            if name == "pose":
                pose, stamp = ros.pose_matrix(message.pose.pose), message.header.stamp
                self.path.append((stamp.sec + 1e-9 * stamp.nanosec, pose))
                numbers = (pose, np.asarray(message.pose.covariance))
                self.not_numbers += not all(np.isfinite(array).all() for array in numbers)
                self.poses.append(now)
            elif name == "tracked":
                self.odometry = message.odometry
                if message.published:
                    self.latencies.append((now, 1e3 * now - 1e-6 * message.captured_monotonic_ns))
            elif isinstance(message, Keyframe):
                self.epoch = max(self.epoch, message.epoch)
            elif name == "health":
                self.health = {
                    row.name: {"level": str(row.level), "message": row.message}
                    | {pair.key: pair.value for pair in row.values}
                    for row in message.status
                }


def client_session(endpoint: str) -> Any:
    """A plain Zenoh client, which connects again whenever it must."""
    settings = {
        "mode": "client",
        "connect/endpoints": [endpoint],
        "connect/timeout_ms": -1,
        "connect/retry": {"period_init_ms": 100, "period_max_ms": 100, "period_increase_factor": 1},
        "scouting/multicast/enabled": False,
        "transport/shared_memory/enabled": False,
    }
    config = zenoh.Config()
    for name, value in settings.items():
        config.insert_json5(name, json.dumps(value))
    return zenoh.open(config)


def start_router(listen: str, *connect: str) -> subprocess.Popen[bytes]:
    """A router in a process of its own; returns once it listens."""
    line = [sys.executable, str(ROOT / "tools" / "faults_router.py"), listen, *connect]
    popen = subprocess.Popen(line, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE)
    assert popen.stdout is not None
    popen.stdout.readline()
    return popen


class Router:
    """A router process that can be restarted, and a client behind it that hears poses."""

    def __init__(self, endpoint: str, watcher: Watcher) -> None:
        self._listen, self._connect = free_endpoint(), endpoint
        self._popen = start_router(self._listen, endpoint)
        self._session = client_session(self._listen)
        self._subscriber = self._session.declare_subscriber(
            "prism/robot/pose", lambda _: watcher.far_poses.append(time.monotonic())
        )

    def restart(self) -> None:
        """SIGKILL, and another in its place."""
        self._popen.kill()
        self._popen.wait()
        self._popen = start_router(self._listen, self._connect)

    def close(self) -> None:
        """End both."""
        self._session.close()
        self._popen.kill()
        self._popen.wait()


def build_clock(folder: Path) -> Path | None:
    """The library that fakes the wall clock; None where there is no C compiler."""
    compiler = shutil.which("cc")
    library = folder / "clock.so"
    if compiler is None:
        return None
    code = ROOT / "tools" / "faults_clock.c"
    line: list[str | Path] = [compiler, "-O1", "-shared", "-fPIC", "-o", library, code, "-ldl"]
    return library if subprocess.run(line, capture_output=True).returncode == 0 else None


@contextlib.contextmanager
def small_disk(folder: Path, megabytes: int = 64) -> Iterator[bool]:
    """``folder`` as a disk of its own, where that is allowed; yields whether it is one."""
    folder.mkdir(exist_ok=True)
    line = ["mount", "-t", "tmpfs", "-o", f"size={megabytes}m", "tmpfs", str(folder)]
    try:
        mounted = subprocess.run(line, capture_output=True).returncode == 0
    except OSError:
        mounted = False
    try:
        yield mounted
    finally:
        if mounted:
            subprocess.run(["umount", "-l", str(folder)], check=False)
