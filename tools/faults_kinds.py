"""The kinds of faults: what each does to a running service, for how long, and how it is undone."""

from __future__ import annotations

import contextlib
import os
import random
import resource
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import psutil

from tools.faults_relay import Relay
from tools.faults_service import Router, Service

WORKERS = ("source", "tracker", "depth", "scale", "backend")
EVERYBODY = (*WORKERS, "supervisor")
STOPPED_S = 5.0
HOUR_S = 3600


@dataclass
class Bench:
    """What faults act on."""

    service: Service
    camera: Relay
    router: Router
    disk: Path
    rng: random.Random
    truncate: Callable[[bool], None]  # whether the camera's pictures are cut short
    clock_s: int = 0


Fault = Callable[[Bench], contextlib.AbstractContextManager[None]]


@dataclass(frozen=True)
class Kind:
    """``length_s``: between doing and undoing it; ``far``: it stops only who listens behind the router.

    ``stops``: no pose can come while it lasts, so its length is not the service's. All others are
    bystanders, whatever their length: poses must go on beside them.
    """

    name: str
    length_s: float
    fault: Fault
    far: bool = False
    stops: bool = False
    new_run: bool = False  # the service ends with it; the next run goes on in the map


def kinds(disk: bool, clock: bool) -> tuple[list[Kind], dict[str, str]]:
    """All that can be done on this host, and what can't, with why. ``disk``: the state has one of its own.

    ``clock``: the service's wall clock can be faked.
    """
    found = [Kind(f"SIGKILL {name}", 0.0, _kill(name), new_run=name == "supervisor") for name in EVERYBODY]
    for name in EVERYBODY:
        found.append(Kind(f"SIGSTOP {name}", STOPPED_S, _stop(name), stops=name in ("source", "tracker")))
    found += [Kind(f"memory limit {name}", STOPPED_S, _starve(name)) for name in WORKERS]
    found += [
        Kind("camera gone", STOPPED_S, _camera_gone, stops=True),
        Kind("truncated frames", STOPPED_S, _truncated),
        Kind("200 ms delay", STOPPED_S, _delayed),
        Kind("router restarted", 0.0, _router_restarted, far=True),
    ]
    skipped = {}
    if disk:
        found.append(Kind("full disk", STOPPED_S, _full_disk))
    else:
        skipped["full disk"] = "no disk of its own can be mounted here"
    if clock:
        found += [Kind("clock +1 h", 0.0, _clock(HOUR_S)), Kind("clock -1 h", 0.0, _clock(-HOUR_S))]
    else:
        skipped["clock +1 h, clock -1 h"] = "there is no C compiler"
    return found, skipped


def named(found: list[Kind], part: str, skipped: dict[str, str]) -> list[Kind]:
    """Those whose name contains ``part``; ends the program where there is none."""
    chosen = [kind for kind in found if part in kind.name]
    if not chosen:
        why = "".join(f"; {name}: {reason}" for name, reason in skipped.items() if part in name)
        raise SystemExit(f"faults: error: no kind that can be made here has {part!r} in its name{why}")
    return chosen


def draw(found: list[Kind], count: int, rng: random.Random) -> list[Kind]:
    """``count`` faults in random order, each kind as often as the others, but for one."""
    drawn: list[Kind] = []
    while len(drawn) < count:
        deck = list(found)
        rng.shuffle(deck)
        drawn += deck
    return drawn[:count]


def _send(bench: Bench, name: str, number: signal.Signals) -> int:
    process = bench.service.processes().get(name)
    if process is None:
        return 0
    with contextlib.suppress(ProcessLookupError):
        os.kill(process.pid, number)
    return process.pid


def _kill(name: str) -> Fault:
    @contextmanager
    def fault(bench: Bench) -> Iterator[None]:
        _send(bench, name, signal.SIGKILL)
        yield

    return fault


def _stop(name: str) -> Fault:
    @contextmanager
    def fault(bench: Bench) -> Iterator[None]:
        pid = _send(bench, name, signal.SIGSTOP)
        yield
        with contextlib.suppress(psutil.Error, ProcessLookupError):
            if pid and psutil.pid_exists(pid):  # it may have been killed as one that hangs
                os.kill(pid, signal.SIGCONT)

    return fault


def _starve(name: str) -> Fault:
    """Half the address space that it has: no new mapping is granted. What is started in its place is free."""

    @contextmanager
    def fault(bench: Bench) -> Iterator[None]:
        process = bench.service.processes().get(name)
        before = None
        if process is not None:
            with contextlib.suppress(psutil.Error, ProcessLookupError, PermissionError):
                before = resource.prlimit(process.pid, resource.RLIMIT_AS)
                resource.prlimit(process.pid, resource.RLIMIT_AS, (process.memory_info().vms // 2, before[1]))
        yield
        if process is not None and before is not None:
            with contextlib.suppress(ProcessLookupError, PermissionError):
                resource.prlimit(process.pid, resource.RLIMIT_AS, before)

    return fault


@contextmanager
def _camera_gone(bench: Bench) -> Iterator[None]:
    bench.camera.gone = True
    yield
    bench.camera.gone = False


@contextmanager
def _truncated(bench: Bench) -> Iterator[None]:
    bench.truncate(True)
    yield
    bench.truncate(False)


@contextmanager
def _delayed(bench: Bench) -> Iterator[None]:
    bench.camera.delay_s = 0.2
    yield
    bench.camera.delay_s = 0.0


@contextmanager
def _router_restarted(bench: Bench) -> Iterator[None]:
    bench.router.restart()
    yield


@contextmanager
def _full_disk(bench: Bench) -> Iterator[None]:
    ballast = bench.disk / "ballast"
    with contextlib.suppress(OSError), ballast.open("wb", buffering=0) as file:
        while True:
            file.write(b"\0" * 65536)
    yield
    ballast.unlink()


def _clock(step_s: int) -> Fault:
    @contextmanager
    def fault(bench: Bench) -> Iterator[None]:
        bench.clock_s += step_s
        bench.service.step_clock(bench.clock_s)
        yield

    return fault
