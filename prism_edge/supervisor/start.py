"""How a worker starts: as a fork of this process, or, once that has threads, by a command line."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

from prism_edge.processes import Process
from prism_edge.supervisor.child import Child
from prism_edge.workers.launch import own_module, run_worker

Start = Callable[[Process, Path, int], Child]  # the last: how often it was started before

# What most workers load, or all (numpy.ma with the first np.unique: in the midst of a keyframe). One that
# starts as a fork has it already, in memory that all of them share.
SHARED = ("prism_edge.bus.session", "prism_edge.bus.ros", "prism_edge.geometry.cameras", "cv2", "numpy.ma")
_THREADS = Path("/proc/self/task")


def start_worker(process: Process, config_file: Path, life: int) -> Child:
    """Start a worker that dies with this process; ``life``: how often it was started before.

    First lives are forks: none loads for itself what all need. Later ones find a supervisor whose session has
    threads, which no fork would have, and start by a command line.
    """
    if can_fork():
        for module in SHARED:
            importlib.import_module(module)
    if can_fork():  # none of them has started a thread
        return Child.fork(partial(run_worker, process, str(config_file), os.getpid(), life))
    return spawn_worker(process, config_file, life)


def can_fork() -> bool:
    """Whether a fork of this process is whole: it has this one thread. Linux only, where that can be told."""
    try:
        return sys.platform == "linux" and len(list(_THREADS.iterdir())) == 1
    except OSError:  # no descriptor is left, of which connections take the most: the bus has threads
        return False


def spawn_worker(process: Process, config_file: Path, life: int) -> Child:
    """As :func:`start_worker`, by a command line."""
    command = [*own_module("prism_edge.workers"), process.name]
    command += ["--config", str(config_file), "--parent", str(os.getpid()), "--life", str(life)]
    return Child.spawn(command)
