"""`prism-edge watch`: the poses of a running daemon, seen by an ordinary subscriber."""

from __future__ import annotations

import argparse
import signal
import sys
import threading
import time
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from prism_edge.cli.live_view import LiveView
from prism_edge.cli.settings import a_path, add_common, config_from, whole_above_zero
from prism_edge.cli.whole_file import check_writable

if TYPE_CHECKING:
    from prism_edge.bus.session import Bus
    from prism_edge.config import Config

WAIT_S = 0.2  # the screen is brought up to date at least this often
_STREAMS = ("/dev", "/dev/fd", "/proc/self/fd")
LINKED_S = 1.0  # a running daemon is linked long before; one that does not run is waited for no longer


def add_parser(subparsers: Any, help_line: str) -> None:
    """Add the subcommand, with its line of `prism-edge --help`."""
    parser: argparse.ArgumentParser = subparsers.add_parser(
        "watch",
        help=help_line,
        description="Subscribe to a running daemon and show pose, speed, scale ± sigma, state, rate and "
        "latency until Ctrl-C. Waits for the daemon where it does not run yet.",
    )
    parser.add_argument(
        "--tum", metavar="FILE", type=a_path, help="record the camera's poses as they come (TUM format)"
    )
    parser.add_argument("--overwrite", action="store_true", help="let --tum replace a file that is there")
    parser.add_argument("--plain", action="store_true", help="print one line a pose instead of a live table")
    parser.add_argument("--count", metavar="N", type=whole_above_zero, help="end after N poses")
    add_common(parser)


def run(args: argparse.Namespace) -> int:
    """Show poses until enough have come; returns the exit code."""
    from prism_edge.bus.session import Bus
    from prism_edge.evaluation.recorder import PoseRecorder, published_mount

    config = config_from(args)
    stream = args.tum is not None and _is_stream(args.tum)
    if args.tum is not None and not stream:
        check_writable(args.tum, args.overwrite)
    _heed_ctrl_c()
    with ExitStack() as stack:
        bus = stack.enter_context(Bus.open(config, "watch"))
        heard = Listener(bus, config)
        recorder = None
        if args.tum:
            mount = partial(published_mount, bus, config.frames)
            recorder = stack.enter_context(PoseRecorder(args.tum, mount, append=stream))
        print(f"watching prism/{config.robot} at {config.bus.endpoint}; Ctrl-C ends", file=sys.stderr)
        show: Plain | Table = Plain() if args.plain else Table()
        stack.enter_context(show)
        while args.count is None or heard.view.poses < args.count:
            for message in heard.poses(args.count):
                if recorder is not None:
                    recorder.record(message)
                show.pose(heard.view)
            show.moment(heard.view)
    return 0


def _is_stream(path: Path) -> bool:
    """What holds no earlier recording: a pipe, a device, or stdout, wherever the shell has it end."""
    if str(path.absolute().parent) in _STREAMS:
        return True
    return path.exists() and not path.is_file() and not path.is_dir()


def _heed_ctrl_c() -> None:
    """A script's shell has what it starts in the background ignore SIGINT, which else nothing could end."""
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.default_int_handler)


class Listener:
    """Subscriptions that keep a LiveView up to date."""

    def __init__(self, bus: Bus, config: Config) -> None:
        from prism_edge.bus.links import on_this_host

        self.view = LiveView()
        self._poses = bus.queue("pose", 1024)
        self._odometry = bus.queue("odom", 1024)
        self._scale, self._status = bus.latest("scale"), bus.latest("status")
        here = on_this_host(config.bus.endpoint)  # the session's own rule: only from elsewhere is it linked
        # Monotonic clocks can be compared on one host only.
        self._tracked = bus.queue("tracked") if here else None
        if here:  # from elsewhere the link is up once the bus is open
            bus.await_ready({"tracker", "scale"}, LINKED_S)
        for inbox, topic in ((self._keep_scale, "scale"), (self._keep_status, "status")):
            last = bus.ask(topic, 0.3)  # published before we came
            if last is not None:
                inbox(last)

    def poses(self, most: int | None) -> Any:
        """Yields each pose as it comes, ending after a moment without any."""
        import numpy as np

        from prism_edge.bus.ros import stamp_ns

        message = self._poses.take(WAIT_S)
        self._others(stamp_ns)
        while message is not None:
            arrival_ns = self._poses.arrived_ns  # the first ones waited while we asked for the rest
            p = message.pose.pose.position
            trace = float(np.trace(np.asarray(message.pose.covariance).reshape(6, 6)[:3, :3]))
            sigma = trace**0.5 if trace >= 0 else float("nan")
            self.view.add_pose(stamp_ns(message), (p.x, p.y, p.z), sigma, arrival_ns)
            yield message
            if most is not None and self.view.poses >= most:
                return
            message = self._poses.take()

    def _others(self, stamp_ns: Any) -> None:
        for message in self._odometry.drain():
            p = message.pose.pose.position
            self.view.add_odometry(stamp_ns(message), (p.x, p.y, p.z), time.monotonic_ns())
        for message in self._scale.drain():
            self._keep_scale(message)
        for message in self._status.drain():
            self._keep_status(message)
        if self._tracked is not None:
            for tick in self._tracked.drain():
                if tick.published:
                    self.view.add_release(tick.stamp_ns, tick.captured_monotonic_ns)

    def _keep_scale(self, message: Any) -> None:
        self.view.scale, self.view.scale_sigma = message.scale, message.sigma_log

    def _keep_status(self, message: Any) -> None:
        if message.status:
            self.view.add_state(message.status[0].message, time.monotonic_ns())


class Plain:
    """One line of text for each pose."""

    def __enter__(self) -> Plain:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def pose(self, view: LiveView) -> None:
        """A pose has come."""
        print(view.line(time.monotonic_ns()), flush=True)

    def moment(self, view: LiveView) -> None:
        """Time has passed: lines are printed for poses only."""


class Table:
    """A table that is kept up to date in place."""

    def __enter__(self) -> Table:
        from rich.live import Live

        self._live = Live(auto_refresh=False)
        self._live.start()
        self._shown_s = 0.0
        return self

    def __exit__(self, *_: object) -> None:
        self._live.stop()

    def pose(self, view: LiveView) -> None:
        """A pose has come; the eye needs no more than a few a second."""
        if time.monotonic() - self._shown_s >= WAIT_S:
            self.moment(view)

    def moment(self, view: LiveView) -> None:
        """Time has passed."""
        from rich.table import Table as RichTable

        self._shown_s = time.monotonic()
        table = RichTable(show_header=False)
        for name, value in view.rows(time.monotonic_ns()):
            table.add_row(name, value)
        self._live.update(table, refresh=True)
