"""`prism-edge demo`: the whole daemon at work on a simulated walk; its poses as they come, and the errors."""

from __future__ import annotations

import argparse
import sys
import threading
import time
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from prism_edge.cli.eval import ended_in_order
from prism_edge.cli.settings import (
    BUNDLED,
    FREE_PORT,
    a_name,
    a_path,
    add_common,
    add_order,
    config_from,
    endpoint_given,
    find_networks,
    is_set,
    source_given,
    with_network,
)
from prism_edge.errors import BusError, ConfigError, SourceError

if TYPE_CHECKING:
    from prism_edge.config import Config

SOURCE = "sim:room?seed=3&frames=1350"
OUT = Path("prism-edge-demo")
PICTURE = "path.png"
LINE_S = 1.0  # between lines where the output is no terminal
_FEWEST = 3  # poses that a picture needs


def add_parser(subparsers: Any, help_line: str) -> None:
    """Add the subcommand, with its line of `prism-edge --help`."""
    parser: argparse.ArgumentParser = subparsers.add_parser(
        "demo",
        help=help_line,
        description="Play a simulated walk through the daemon in real time, with the depth network that "
        "comes with prism_edge, show its poses as an ordinary Zenoh subscriber gets them, and compare them "
        "with the truth. Needs no camera, no recording and no connection. The folder DIR receives what "
        "`eval` writes (docs/EVALUATION.md), and path.png, a picture of both paths.",
    )
    parser.add_argument(
        "source",
        metavar="SIM",
        nargs="?",
        help=f"simulated world (default: the configuration's where it has one, else {SOURCE})",
    )
    parser.add_argument(
        "--out", metavar="DIR", type=a_path, default=OUT, help=f"where results go (default: {OUT})"
    )
    parser.add_argument(
        "--model",
        metavar="MODEL",
        type=a_name,
        help=f"depth network: ONNX file, known name or nested:RELATIVE,METRIC (default: {BUNDLED})",
    )
    add_order(parser)
    add_common(parser, FREE_PORT)


def run(args: argparse.Namespace) -> int:
    """Play, show, sum up; returns the exit code. Raises PrismError."""
    from prism_edge.config import FramesConfig, SourceConfig, TrackingConfig
    from prism_edge.evaluation.run import on_free_endpoint
    from prism_edge.sources.address import shown_address
    from prism_edge.sources.sim import is_simulated

    config = config_from(args)
    if source_given(args) or not is_simulated(config.source.uri):  # a robot's own file is of its camera
        uri, plain = config.source.uri if source_given(args) else SOURCE, SourceConfig()
        of_camera = ("camera", "mask", "rate_hz", "shrink", "loop")
        unset = (key for key in of_camera if not is_set(args, f"source.{key}"))
        source = replace(config.source, uri=uri, **{key: getattr(plain, key) for key in unset})
        frames, tracking = config.frames, config.tracking
        if not is_set(args, "frames.base_from_camera_xyzw"):  # the simulated one is upright
            frames = replace(frames, base_from_camera_xyzw=FramesConfig().base_from_camera_xyzw)
        if not is_set(args, "tracking.readout_ms"):
            tracking = replace(tracking, readout_ms=TrackingConfig().readout_ms)
        config = with_network(replace(config, source=source, frames=frames, tracking=tracking))
    if not is_simulated(config.source.uri):
        shown = shown_address(config.source.uri)
        raise SourceError(f"{shown}: the demo plays simulated worlds; use `prism-edge eval`")
    if not config.depth.network:
        raise ConfigError("the demo needs a depth network: without one no pose comes; leave --model out")
    find_networks(config)
    # SystemExit passes through the blocks that end the daemon.
    with ended_in_order():
        report = play(config if endpoint_given(args) else on_free_endpoint(config), args.out)
    extent = extent_m(config.source.uri, config.source.frames)
    sum_up(report, args.out, draw(config.source.uri, args.out, report), extent)
    return 0


def play(config: Config, out: Path) -> dict[str, Any]:
    """The walk through the real daemon, its poses on the screen; returns the metrics."""
    from prism_edge.bus.keys import check_endpoint, check_robot_name
    from prism_edge.bus.vacancy import check_vacant
    from prism_edge.evaluation.run import evaluate, extent

    check_robot_name(config.robot)
    check_endpoint(config.bus.endpoint)
    check_vacant(config.bus.endpoint)
    _, frames = extent(config.source)
    with suppress(BrokenPipeError):  # files are wanted, too, by who reads no more
        print(f"playing {config.source.uri} ({frames} frames) with the depth network {config.depth.model}")
        print(f"subscribing to prism/{config.robot}/pose at {config.bus.endpoint}", flush=True)
    over = threading.Event()
    screen = threading.Thread(target=keep_showing, args=(config, over), name="screen", daemon=True)
    screen.start()
    try:
        return evaluate(config, out, quiet=True, keep_endpoint=True, further=(PICTURE,))
    finally:
        over.set()
        screen.join(timeout=5.0)


def keep_showing(config: Config, over: threading.Event) -> None:
    """As :func:`show`, in a thread of its own."""
    # Who can't reach the bus or write to stdout is told by the run, which stands before the same.
    with suppress(BusError, OSError):
        show(config, over)


def show(config: Config, over: threading.Event) -> None:
    """Poses as they arrive at a subscriber: a table, or a line a second where there is no terminal."""
    from prism_edge.bus.session import Bus
    from prism_edge.cli.watch import Listener, Table

    with ExitStack() as stack:
        bus = stack.enter_context(Bus.open(replace(config, mode="realtime"), "watch"))
        heard = Listener(bus, config)
        table = stack.enter_context(Table()) if sys.stdout.isatty() else None
        line_s = 0.0
        while not over.is_set():
            for _ in heard.poses(None):
                now = time.monotonic()
                if table is not None:
                    table.pose(heard.view)
                elif now - line_s >= LINE_S:
                    line_s = now
                    print(heard.view.line(time.monotonic_ns()), flush=True)


def draw(uri: str, out: Path, report: dict[str, Any]) -> Path | None:
    """Writes the picture of both paths from above; None where too few came to compare. Raises OSError."""
    import cv2

    from prism_edge.evaluation.draw_paths import ESTIMATE, TRUTH, draw_paths
    from prism_edge.evaluation.trajectory import Trajectory, associate, read_tum
    from prism_edge.geometry.alignment import align
    from prism_edge.sources.truth import read_truth

    own = read_truth(uri)
    if own is None or report["live"]["ate_se3_m"] is None:
        return None
    estimate, truth = associate(read_tum(out / "live.tum"), Trajectory(*own))
    if len(estimate) < _FEWEST:
        return None
    # The truth is brought to the estimate, turned and moved only: what differs in size shows.
    moved = align(truth.positions, estimate.positions, with_scale=False).apply(truth.positions)
    paths = [("truth", TRUTH, moved[:, :2]), ("as published", ESTIMATE, estimate.positions[:, :2])]
    error_cm = 100.0 * report["live"]["ate_se3_m"]
    picture = draw_paths(paths, f"the camera's path from above: {error_cm:.1f} cm (RMS) from the truth")
    file = out / PICTURE
    file.write_bytes(cv2.imencode(".png", picture)[1].tobytes())
    return file


def extent_m(uri: str, frames: int) -> float:
    """The longest side (m) of the box round the true path, or round that of its first ``frames`` (0: all)."""
    import numpy as np

    from prism_edge.sources.truth import read_truth

    own = read_truth(uri)
    return 0.0 if own is None else float(np.ptp(own[1][: frames or None, :3, 3], axis=0).max())


def sum_up(report: dict[str, Any], out: Path, picture: Path | None, extent: float) -> None:
    """The figures that matter, and where the rest is."""
    live, latency, cpu = report["live"], report["latency_ms"], report["cpu_ms_per_frame"]

    def number(value: float | None, form: str) -> str:
        return "-" if value is None else form.format(value)

    ratio, error = live["scale_ratio"], live["ate_se3_m"]
    share = ""
    if error and extent:
        share = f" ({100 * error / extent:.1f} % of the path's extent, {extent:.2f} m)"
    rows = [
        ("poses", f"{report['tracked']} of {report['frames']} frames, {report['dropped_frames']} dropped"),
        ("coverage", number(report["coverage"], "{:.3f}")),
        ("rate", number(report["fps"], "{:.1f} Hz")),
        ("latency p50, p99", f"{number(latency['p50'], '{:.1f}')}, {number(latency['p99'], '{:.1f}')} ms"),
        ("CPU, all processes", number(cpu["total"], "{:.1f} ms a frame")),
        ("position error (ATE)", number(error, "{:.4f} m") + f", metres as published: SE(3){share}"),
        ("", number(live["ate_sim3_m"], "{:.4f} m") + ", after correcting the scale: Sim(3)"),
        ("scale error", "-" if ratio is None else f"{100 * abs(1 / ratio - 1):.1f} %"),
        ("ready after", number(report["ready_s"], "{:.2f} s")),
        ("poses and figures", str(out)),
        ("picture", str(picture) if picture else "-"),
    ]
    if report["timings_void"]:
        rows.insert(5, ("", "other programs kept this machine busy: rate and latency say little"))
    print()
    for name, value in rows:
        print(f"{name:<22}{value}")
