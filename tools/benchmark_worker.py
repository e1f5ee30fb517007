"""What the depth worker adds to its network: latency beside bare onnxruntime, and idleness between keyframes.

    python tools/benchmark_worker.py MODEL [--threads N] [--runs N] [--rest S]

A real worker process on a bus of its own and a bare onnxruntime session on the same file take turns, so that
whatever else the machine does slows both. A ratio is the median over the turns. The worker's time is told
twice: as it stands in its message (resizing, inference, metres) and from the picture's publication to the
depth's arrival in another process. Beside that stands the CPU time of both, all threads and all that belongs
to answering, as a ratio of sums: on a machine with other work it says more. Then the worker gets nothing for
a while, and then a keyframe now and then. A relative network, which the daemon does not run alone, is timed
as if its depths were metres.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import yaml

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from prism_edge.bus.inbox import Inbox
from prism_edge.bus.pack import pack
from prism_edge.bus.session import Bus
from prism_edge.bus.vacancy import free_endpoint
from prism_edge.cli.settings import seconds_above_zero, whole_above_zero
from prism_edge.config import BusConfig, Config, DepthConfig
from prism_edge.config_file import dump
from prism_edge.depth import OnnxNetwork, locate, open_onnx
from prism_edge.depth.cards import sidecar_of
from prism_edge.depth.contract import CONTRACT, METRIC
from prism_edge.depth.providers import provider_options, session_options, with_own_engines
from prism_edge.errors import ModelError, PrismError
from prism_edge.geometry.cameras import Camera
from prism_edge.messages import Depth, KeyframeImage

# isort: split
import onnxruntime  # after prism_edge, which keeps it from reporting to its makers

CAMERA = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
WARM_UP = 3
PATIENCE_S = 60.0
KEYFRAME_S = 0.5  # between keyframes of the last part


@dataclass(frozen=True)
class Turn:
    """One inference each, in ms."""

    bare: float
    worker: float  # as its message says
    round_trip: float
    bare_cpu: float
    worker_cpu: float  # counted in the kernel's ticks: only sums mean something


class Worker:
    """A depth worker process, and what is said to it."""

    def __init__(self, bus: Bus, process: psutil.Process) -> None:
        self._bus, self._process = bus, process
        self._depths: Inbox = bus.queue("depth")
        self._keyframe = 0

    def ask(self, patience_s: float = PATIENCE_S) -> tuple[Depth | None, float]:
        """The depth of one picture, None where none came in time, and the ms that it took."""
        self._keyframe += 1
        rng = np.random.default_rng(self._keyframe)
        coarse = rng.integers(0, 256, (12, 16, 3), dtype=np.uint8)
        image, colour = pack(coarse.repeat(40, axis=0).repeat(40, axis=1))
        n, camera = self._keyframe, CAMERA.to_array()
        picture = KeyframeImage(n, n, n, 0, colour, CAMERA.model, camera, image)
        started = time.perf_counter()
        self._bus.publish("keyframe_image", picture)
        while (left := started + patience_s - time.perf_counter()) > 0:
            depth = self._depths.take(left)
            if depth is not None and depth.keyframe == n:
                return depth, 1e3 * (time.perf_counter() - started)
        return None, 1e3 * patience_s

    def cpu_s(self) -> float:
        """User and system time so far, all threads."""
        times = self._process.cpu_times()
        return float(times.user + times.system)


def main(arguments: list[str] | None = None) -> int:
    form = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=form)
    parser.add_argument("model", metavar="MODEL", help="ONNX file or known name of a network")
    parser.add_argument(
        "--threads", type=whole_above_zero, default=1, metavar="N", help="of one inference (default 1)"
    )
    parser.add_argument("--runs", type=whole_above_zero, default=40, metavar="N", help="turns (default 40)")
    parser.add_argument(
        "--rest", type=seconds_above_zero, default=10.0, metavar="S", help="seconds of rest (default 10)"
    )
    args = parser.parse_args(arguments)
    try:
        report(args.model, args.threads, args.runs, args.rest)
    except PrismError as error:
        print(f"benchmark_worker: error: {error}", file=sys.stderr)
        return error.exit_code
    return 0


def report(model: str, threads: int, runs: int, rest_s: float) -> None:
    """Measures and prints. Raises ModelError where the network or its worker can't be run."""
    depth = DepthConfig(model=str(locate(model).resolve()), threads=threads)
    network = open_onnx(depth.model, depth)
    bare, feed = bare_session(network, depth)
    print(f"{network.name} on {network.provider}, {threads} thread(s)")
    with as_metric(network) as file, running_worker(replace(depth, model=str(file))) as worker:
        turns = list(take_turns(worker, bare, feed, runs))
        show_turns(turns)
        print(f"CPU at rest: {100 * rest(worker, rest_s):.2f} % of a core over {rest_s:g} s")
        busy, between = now_and_then(worker, max(4, round(rest_s / KEYFRAME_S)))
        print(f"CPU of a keyframe: {1e3 * busy:.1f} ms; between keyframes: {100 * between:.2f} % of a core")


@contextmanager
def as_metric(network: OnnxNetwork) -> Iterator[Path]:
    """The network's file; of one without metres a link to it whose sidecar says that it has them."""
    if network.card.has_metres:
        yield network.path
        return
    metric = replace(network.card, name="benchmark", depth_kind=METRIC, scale_bias_sigma=0.1)
    kept = {key: value for key, value in asdict(metric).items() if value not in (None, "")}
    card = {key: list(value) if isinstance(value, tuple) else value for key, value in kept.items()}
    with tempfile.TemporaryDirectory() as folder:
        link = Path(folder) / "network.onnx"
        link.symlink_to(network.path)
        sidecar_of(link).write_text(yaml.safe_dump({"contract": CONTRACT, **card}), encoding="utf-8")
        yield link


def bare_session(network: OnnxNetwork, depth: DepthConfig) -> tuple[Any, dict[str, Any]]:
    """onnxruntime on the same file with the same options, and an input for it."""
    depth = with_own_engines(depth, network.fingerprint)
    providers = [(network.provider, provider_options(network.provider, depth))]
    session = onnxruntime.InferenceSession(str(network.path), session_options(depth), providers)
    card = network.card
    shape = (1, 3, card.input_height, card.input_width)
    values = np.random.default_rng(0).normal(0.0, 1.0, shape).astype(np.float32)
    return session, {session.get_inputs()[0].name: values}


def take_turns(worker: Worker, bare: Any, feed: dict[str, Any], runs: int) -> Iterator[Turn]:
    """Worker and bare session alternate; who begins alternates too."""
    for turn in range(runs + WARM_UP):
        first = turn % 2 == 0
        bare_ms, bare_cpu = _bare_ms(bare, feed) if first else (0.0, 0.0)
        before = worker.cpu_s()
        depth, round_trip = worker.ask()
        worker_cpu = 1e3 * (worker.cpu_s() - before)
        if depth is None or not depth.inference_ms:
            raise ModelError(f"the worker gave no depth ({depth.reason if depth else 'nothing came'})")
        if not first:
            bare_ms, bare_cpu = _bare_ms(bare, feed)
        if turn >= WARM_UP:
            yield Turn(bare_ms, depth.inference_ms, round_trip, bare_cpu, worker_cpu)


def show_turns(turns: list[Turn]) -> None:
    """Medians in ms, and the median of each turn's ratio; means of CPU time, and the ratio of those."""
    bare = statistics.median(turn.bare for turn in turns)
    print(f"bare onnxruntime        {bare:8.2f} ms")
    for name, words in (("worker", "worker, its own time"), ("round_trip", "picture sent to depth")):
        values = [getattr(turn, name) for turn in turns]
        ratio = statistics.median(value / turn.bare for value, turn in zip(values, turns, strict=True))
        print(f"{words:<24}{statistics.median(values):8.2f} ms   {ratio:.3f} x bare")
    bare_cpu = statistics.mean(turn.bare_cpu for turn in turns)
    worker_cpu = statistics.mean(turn.worker_cpu for turn in turns)
    print(f"CPU time: bare          {bare_cpu:8.2f} ms")
    print(f"CPU time: worker        {worker_cpu:8.2f} ms   {worker_cpu / bare_cpu:.3f} x bare")


def rest(worker: Worker, seconds: float) -> float:
    """Cores that the worker takes while nothing comes."""
    cpu, started = worker.cpu_s(), time.perf_counter()
    time.sleep(seconds)
    return (worker.cpu_s() - cpu) / (time.perf_counter() - started)


def now_and_then(worker: Worker, keyframes: int) -> tuple[float, float]:
    """CPU seconds of one keyframe, and cores taken between keyframes at two a second."""
    cpu = worker.cpu_s()
    for _ in range(keyframes):
        worker.ask()
    busy = (worker.cpu_s() - cpu) / keyframes
    cpu, started, answered = worker.cpu_s(), time.perf_counter(), 0.0
    for _ in range(keyframes):
        answered += worker.ask()[1] / 1e3
        time.sleep(KEYFRAME_S)
    idle_s = time.perf_counter() - started - answered
    return busy, max(0.0, worker.cpu_s() - cpu - keyframes * busy) / idle_s


@contextmanager
def running_worker(depth: DepthConfig) -> Iterator[Worker]:
    """A worker process that answers, until the block ends. Raises ModelError where none comes to answer."""
    config = Config(robot="benchmark", bus=BusConfig(free_endpoint()), depth=depth)
    with tempfile.TemporaryDirectory() as folder, Bus.open(config, "supervisor", listen=True) as bus:
        file = Path(folder) / "config.yaml"
        file.write_text(dump(config), encoding="utf-8")
        command = [sys.executable, "-m", "prism_edge.workers", "depth", "--config", str(file)]
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
        child = subprocess.Popen([*command, "--parent", str(os.getpid())], env=environment)
        try:
            worker = Worker(bus, psutil.Process(child.pid))
            deadline = time.monotonic() + PATIENCE_S
            while worker.ask(1.0)[0] is None:  # what is sent before it has joined is lost
                if child.poll() is not None or time.monotonic() > deadline:
                    raise ModelError("the worker does not answer")
            yield worker
        finally:
            child.terminate()
            child.wait(10.0)


def _bare_ms(session: Any, feed: dict[str, Any]) -> tuple[float, float]:
    """Wall time and CPU time of one run."""
    started, cpu = time.perf_counter(), time.process_time()
    session.run(None, feed)
    return 1e3 * (time.perf_counter() - started), 1e3 * (time.process_time() - cpu)


if __name__ == "__main__":
    sys.exit(main())
