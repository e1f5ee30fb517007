"""Everyone who runs: one table of processes. Each is ``main(config, bus)`` in a module of workers/."""

from __future__ import annotations

from dataclasses import dataclass

from prism_edge.config import Config


@dataclass(frozen=True)
class Process:
    """One supervised process."""

    name: str
    module: str
    does: str
    required: bool  # poses can't flow without it
    nice: int = 0  # the camera-rate path runs before the solvers


PROCESSES = {
    process.name: process
    for process in (
        Process("source", "prism_edge.workers.source", "reads the camera or recording", True),
        Process("tracker", "prism_edge.workers.tracker", "tracks the camera, owns the local map", True),
        Process("depth", "prism_edge.workers.depth", "runs the depth network on keyframes", False, nice=5),
        Process("scale", "prism_edge.workers.scale", "estimates metres per map unit", False, nice=5),
        Process("backend", "prism_edge.workers.backend", "optimises the map", False, nice=5),
    )
}

LOADING_S = 120.0  # that a depth network may take to load: depth's, and in lockstep source waits for it


def processes_for(config: Config) -> tuple[Process, ...]:
    """The processes that a run with this configuration consists of, in the order they start.

    depth runs only where a network is configured. scale always does: a loaded map has its metres, and they
    get less sure with what is built on it.
    """
    return tuple(p for p in PROCESSES.values() if config.depth.network or p.name != "depth")


def peers_of(config: Config, name: str) -> set[str]:
    """Names of the processes that run beside this one."""
    return {process.name for process in processes_for(config)} - {name}
