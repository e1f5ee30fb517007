"""Shows the whole daemon at work: a generated sequence in, metric poses at a subscriber out.

    python tools/demo.py [--out DIR] [--frames N]

A room of textured planes is drawn as a hand-held camera sees it, so that the truth is known exactly, with
a tiny network that reads depth from the picture's tint. The daemon plays that in real time; an ordinary
Zenoh subscriber shows its poses as they arrive. At the end come the errors, and a picture of both paths.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import threading
import time
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from prism_edge.bus.session import Bus
from prism_edge.cli.watch import Listener, Table
from prism_edge.config import BusConfig, Config, DepthConfig, SourceConfig
from prism_edge.errors import PrismError
from prism_edge.evaluation.daemon import free_endpoint
from prism_edge.evaluation.run import evaluate
from prism_edge.evaluation.trajectory import Trajectory, associate, read_tum
from prism_edge.geometry.alignment import align
from prism_edge.sources.truth import read_truth
from tests.synthetic.network import write_tiny_network
from tests.synthetic.sequence import write_sequence
from tools.draw_paths import ESTIMATE, TRUTH, draw_paths

ROOT = Path(__file__).resolve().parents[1]
WIDTH, HEIGHT = 480, 360
LINE_S = 1.0  # between lines where the output is no terminal


def main(arguments: list[str] | None = None) -> int:
    """Generate, run, show, sum up; returns the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", metavar="DIR", type=Path, default=ROOT / "build" / "demo")
    parser.add_argument("--frames", metavar="N", type=int, default=300, help="at 30 a second (default 300)")
    args = parser.parse_args(arguments)
    try:
        with tempfile.TemporaryDirectory(prefix="prism-edge-demo-") as folder:
            print(f"drawing {args.frames} images of a room, {WIDTH}x{HEIGHT} ...", flush=True)
            sequence = write_sequence(Path(folder) / "room", args.frames, WIDTH, HEIGHT)
            network = write_tiny_network(Path(folder) / "tiny.onnx")
            report = play(sequence, network, args.out)
            picture = draw(sequence, args.out, report)
    except PrismError as error:
        print(f"demo: error: {error}", file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        return 130
    sum_up(report, args.out, picture)
    return 0


def play(sequence: Path, network: Path, out: Path) -> dict[str, Any]:
    """The sequence through the real daemon in real time, its poses on the screen; returns the metrics."""
    config = Config(
        bus=BusConfig(endpoint=free_endpoint()),
        source=SourceConfig(uri=str(sequence), camera=str(sequence / "camera.yaml")),
        depth=DepthConfig(model=str(network)),
    )
    print(f"starting the daemon; subscribing to prism/robot/pose at {config.bus.endpoint}", flush=True)
    over = threading.Event()
    screen = threading.Thread(target=show, args=(config, over), name="screen", daemon=True)
    screen.start()
    try:
        return evaluate(config, out, quiet=True)
    finally:
        over.set()
        screen.join(timeout=5.0)


def show(config: Config, over: threading.Event) -> None:
    """Poses as they arrive at a subscriber: a table, or a line a second where there is no terminal."""
    with ExitStack() as stack:
        bus = stack.enter_context(Bus.open(replace(config, mode="realtime"), "watch"))
        heard = Listener(bus, config)
        table = stack.enter_context(Table()) if sys.stdout.isatty() else None
        line_s = 0.0
        while not over.is_set():
            for _ in heard.poses(None):
                now = time.monotonic()
                if table is None and now - line_s >= LINE_S:
                    line_s = now
                    print(heard.view.line(time.monotonic_ns()), flush=True)
                elif table is not None:
                    table.pose(heard.view)


def draw(sequence: Path, out: Path, report: dict[str, Any]) -> Path | None:
    """Writes the picture of both paths from above; None where too few poses came to compare."""
    own = read_truth(str(sequence))
    live = out / "live.tum"
    if own is None or not report["tracked"]:
        return None
    estimate, truth = associate(read_tum(live), Trajectory(*own))
    if len(estimate) < 3:
        return None
    # The truth is brought to the estimate, turned and moved only: what differs in size shows.
    moved = align(truth.positions, estimate.positions, with_scale=False).apply(truth.positions)
    paths = [("truth", TRUTH, moved[:, :2]), ("as published", ESTIMATE, estimate.positions[:, :2])]
    error_cm = 100.0 * (report["live"]["ate_se3_m"] or 0.0)
    picture = draw_paths(paths, f"the camera's path from above: {error_cm:.1f} cm (RMS) from the truth")
    file = out / "path.png"
    cv2.imwrite(str(file), picture)
    return file


def sum_up(report: dict[str, Any], out: Path, picture: Path | None) -> None:
    """The figures that matter, and where the rest is."""
    live, latency, cpu = report["live"], report["latency_ms"], report["cpu_ms_per_frame"]

    def number(value: float | None, form: str) -> str:
        return "-" if value is None else form.format(value)

    ratio = live["scale_ratio"]
    rows = (
        ("poses", f"{report['tracked']} of {report['frames']} frames, {report['dropped_frames']} dropped"),
        ("rate", number(report["fps"], "{:.1f} Hz")),
        ("latency p50, p99", f"{number(latency['p50'], '{:.1f}')}, {number(latency['p99'], '{:.1f}')} ms"),
        ("CPU, all processes", number(cpu["total"], "{:.1f} ms a frame")),
        ("position error (ATE)", number(live["ate_se3_m"], "{:.4f} m") + ", metres as published: SE(3)"),
        ("", number(live["ate_sim3_m"], "{:.4f} m") + ", after correcting the scale: Sim(3)"),
        ("scale error", "-" if ratio is None else f"{100 * abs(1 / ratio - 1):.1f} %"),
        ("ready after", number(report["ready_s"], "{:.2f} s")),
        ("poses and figures", str(out)),
        ("picture", str(picture) if picture else "-"),
    )
    print()
    for name, value in rows:
        print(f"{name:<22}{value}")


if __name__ == "__main__":
    sys.exit(main())
