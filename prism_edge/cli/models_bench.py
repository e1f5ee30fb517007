"""`prism-edge models bench`: what a network costs here, each setting in a fresh process of its own."""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import signal
import statistics
import time
from dataclasses import asdict, dataclass, replace
from multiprocessing.connection import Connection
from typing import Any

from rich.console import Console
from rich.table import Table

from prism_edge.config import DepthConfig
from prism_edge.config_file import load
from prism_edge.errors import ModelError
from prism_edge.geometry.cameras import Camera

WIDTH, HEIGHT = 640, 480  # of the camera image that is resized
_PATIENCE_S = 600.0


@dataclass(frozen=True)
class Cost:
    """What one setting costs. Latencies include resizing a 640x480 image."""

    provider: str  # that really ran
    load_s: float
    median_ms: float
    p90_ms: float
    cpu_ms: float  # of an inference, all threads
    memory_mb: float  # that loading and running it added


def run(args: argparse.Namespace) -> int:
    """Time every combination; returns the exit code. Raises ModelError where none can be run."""
    threads = args.threads or _powers(_cores())
    providers, missing = _there(args.providers or _offered())
    base = load(args.config).depth
    console = Console(highlight=False, markup=False, emoji=False)
    table = Table(title=f"{args.model}: {args.runs} inferences each on a {WIDTH}x{HEIGHT} image")
    for heading in ("provider", "threads", "median ms", "p90 ms", "CPU ms", "load s", "memory MB"):
        table.add_column(heading, justify="left" if heading == "provider" else "right")
    failures = missing
    for provider in providers:
        for count in threads:
            only = (provider,)
            config = replace(base, model=args.model, providers=only, required=only, threads=count)
            try:
                cost = measure(config, args.runs)
            except ModelError as error:
                failures.append(str(error))
                continue
            table.add_row(
                cost.provider.removesuffix("ExecutionProvider"),
                str(count),
                *(f"{value:.1f}" for value in (cost.median_ms, cost.p90_ms, cost.cpu_ms)),
                f"{cost.load_s:.2f}",
                f"{cost.memory_mb:.0f}",
            )
    if not table.row_count:
        raise ModelError(failures[0])
    console.print(table)
    for line in dict.fromkeys(failures):
        console.print(line, soft_wrap=True)
    busy = os.getloadavg()[0] if hasattr(os, "getloadavg") else 0.0
    console.print(f"{_cores()} cores, load {busy:.1f}: on a busy machine these are upper bounds.")
    return 0


def measure(config: DepthConfig, runs: int) -> Cost:
    """The cost of ``config.model`` under ``config``, in a new process. Raises ModelError."""
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe()
    child = context.Process(target=_child, args=(there, config, runs), daemon=True)
    # Ctrl-C is for us, who end the child: it inherits that it is to ignore it.
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        child.start()
    finally:
        signal.signal(signal.SIGINT, before)
    there.close()
    try:
        if not here.poll(_PATIENCE_S):
            raise ModelError(f"{config.model}: has not ended in {_PATIENCE_S:g} s")
        answer = json.loads(here.recv_bytes())
    except EOFError:
        child.join()
        raise ModelError(f"{config.model}: the process died ({child.exitcode}); too little memory?") from None
    finally:
        child.terminate()
        child.join()
    if isinstance(answer, str):
        raise ModelError(answer)
    return Cost(**answer)


def _child(pipe: Connection, config: DepthConfig, runs: int) -> None:
    answer: dict[str, Any] | str
    try:
        answer = asdict(_cost(config, runs))
    except ModelError as error:
        answer = str(error)
    pipe.send_bytes(json.dumps(answer).encode())


def _cost(config: DepthConfig, runs: int) -> Cost:
    import cv2
    import numpy as np
    import psutil

    from prism_edge.depth import NESTED, OnnxNetwork, open_network, open_onnx  # with onnxruntime

    cv2.setNumThreads(1)
    process = psutil.Process()
    before = process.memory_full_info().uss
    started = time.perf_counter()
    # A relative network can be timed too: what is timed then is its answer without metres.
    paired = config.model.startswith(NESTED)
    network = open_network(config.model, config) if paired else open_onnx(config.model, config)
    loaded = time.perf_counter() - started
    image = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    camera = Camera(WIDTH, HEIGHT, 0.8 * WIDTH, 0.8 * WIDTH, WIDTH / 2, HEIGHT / 2)
    times: list[float] = []
    cpu = time.process_time()
    for _ in range(runs):
        began = time.perf_counter()
        if isinstance(network, OnnxNetwork):
            network.raw(image)
        else:
            network.infer(image, camera)
        times.append(1e3 * (time.perf_counter() - began))
    cpu_ms = 1e3 * (time.process_time() - cpu) / runs
    added = (process.memory_full_info().uss - before) / 2**20
    p90 = float(np.percentile(times, 90))
    return Cost(network.provider, loaded, statistics.median(times), p90, cpu_ms, added)


def _there(providers: list[str]) -> tuple[list[str], list[str]]:
    """Those of some providers that this onnxruntime has, and a line for each of the others. ModelError."""
    import onnxruntime

    from prism_edge.depth.providers import full_name, lacking

    offered = onnxruntime.get_available_providers()
    full = {name: full_name(name, "--providers") for name in providers}
    missing = [lacking(known, offered) for known in full.values() if known not in offered]
    return [name for name, known in full.items() if known in offered], missing


def _offered() -> list[str]:
    import onnxruntime

    from prism_edge.depth.providers import SHORT, short_name

    names = [short_name(name) for name in onnxruntime.get_available_providers()]
    return [name for name in names if name in SHORT]


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _powers(cores: int) -> list[int]:
    """1, 2, 4 ... and the number of cores."""
    return sorted({*(2**n for n in range(7) if 2**n <= cores), min(cores, 64)})
