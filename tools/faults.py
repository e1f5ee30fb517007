"""The fault programme: random faults on the running service, and whether poses outlive them.

    python tools/faults.py [--count 100] [--seed 0] [--out build/faults]

A looping network camera is tracked in real time by `prism-edge run`, which is started again when it ends, as
systemd would. A subscriber measures how long poses stop. Writes report.json and report.md; the exit code is
1 where a bar is not met. What a host doesn't permit (docs/FAULTS.md) is skipped, and the report says so.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import random
import signal
import statistics
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from tests.sources.live.servers import MjpegServer, mjpeg_server
from tools.faults_kinds import Bench, Kind, draw, kinds, named
from tools.faults_relay import Relay
from tools.faults_service import (
    Router,
    Service,
    Watcher,
    build_clock,
    draw_room,
    service_config,
    small_disk,
)

RATE_HZ = 20.0
LONGEST_S, MEDIAN_S = 3.0, 2.0  # bars: without poses, beyond the length of a fault that stops them
RECOVERED_S = 60.0  # what is not well by then is not waited for any longer
DESCRIPTORS = 12  # more than at the start in one process: a leak (links to who was started again vary)


@dataclass
class Outcome:
    """One fault."""

    kind: str
    at_s: float
    length_s: float
    gap_s: float  # longest time without a pose
    beyond_s: float  # of it, beyond the fault's own length, where that stops poses by itself
    recovered_s: float | None  # from its end until everything was well
    epochs: int  # maps begun
    keyframes: tuple[int, int]  # in the backend's map, before and after
    new_run: bool
    exits: int  # of the service


def main(arguments: list[str] | None = None) -> int:
    """Run the programme; returns the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--count", type=int, default=100, help="faults (default 100)")
    parser.add_argument("--seed", type=int, default=0, help="of their order and times (default 0)")
    parser.add_argument("--only", default="", help="kinds whose name contains this")
    parser.add_argument("--budget-s", type=float, default=7200.0, help="begin no fault after so many seconds")
    parser.add_argument("--out", type=Path, default=Path("build/faults"), help="folder of the report")
    args = parser.parse_args(arguments)
    args.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="prism-edge-faults-") as name:
        report = programme(Path(name), args.count, args.seed, args.only, args.budget_s, args.out)
    (args.out / "report.json").write_text(json.dumps(report, indent=1) + "\n")
    text = markdown(report)
    (args.out / "report.md").write_text(text)
    print(text)
    return 0 if all(bar["met"] for bar in report["bars"].values()) else 1


def programme(folder: Path, count: int, seed: int, only: str, budget_s: float, out: Path) -> dict[str, Any]:
    """The whole run; ``folder`` is for what it needs on the way."""
    room = draw_room(folder)
    shared_memory = _shared_memory()
    with contextlib.ExitStack() as stack:
        server = stack.enter_context(mjpeg_server())
        server.picture = lambda k: room.pictures[k % len(room.pictures)]
        server.period_s = 1.0 / RATE_HZ
        camera = stack.enter_context(Relay(("127.0.0.1", 0), ("127.0.0.1", server.server_address[1])))
        state = folder / "state"
        own_disk = stack.enter_context(small_disk(state))
        uri = f"http://127.0.0.1:{camera.port}/video#timeout=1"
        config = service_config(uri, room, state)
        clock = build_clock(folder)
        service = stack.enter_context(Service(folder, config, clock))
        stack.callback(lambda: (out / "daemon.log").write_bytes(service.log.read_bytes()))
        watcher = Watcher(config)
        stack.callback(watcher.close)
        router = Router(config.bus.endpoint, watcher)
        stack.callback(router.close)
        begun_s = time.monotonic()
        if _until_well(watcher, 120.0) is None:
            raise SystemExit(f"faults: error: no poses in two minutes; see {out / 'daemon.log'}")
        time.sleep(5.0)
        undisturbed_s = watcher.longest_gap(time.monotonic() - 5.0, time.monotonic())
        before = {"pss_mb": service.memory_mb(), "descriptors": service.descriptors()}
        rng = random.Random(seed)
        bench = Bench(service, camera, router, state, rng, lambda on: _truncate(server, on, rng))
        possible, skipped = kinds(own_disk, clock is not None)
        possible = named(possible, only, skipped)
        outcomes = []
        for number, kind in enumerate(draw(possible, count, rng)):
            if time.monotonic() - begun_s > budget_s:
                break
            outcomes.append(one(kind, bench, watcher, begun_s))
            o = outcomes[-1]
            print(
                f"{number + 1:>4} {o.kind:<22} {o.beyond_s:5.2f} s beyond, map {o.keyframes}", flush=True
            )
        well = _until_well(watcher, RECOVERED_S) is not None
        after = {"pss_mb": service.memory_mb(), "descriptors": service.descriptors()}
        code = service.stop()
        leftovers = [process.name() for process in service.marked()]
        leftovers += [str(path.name) for path in (folder / "runtime").glob("*prism-edge-run-*")]
        leftovers += sorted(_shared_memory() - shared_memory)
        half = [str(p.relative_to(state)) for p in state.rglob(".*")]  # as map_file.write names them
        log = service.log.read_text(errors="replace")
        return {
            "seed": seed,
            "rate_hz": RATE_HZ,
            "skipped": skipped,
            "undisturbed_gap_s": round(undisturbed_s, 3),
            "outcomes": [asdict(outcome) for outcome in outcomes],
            "service_exits": service.exits,
            "last_exit": code,
            "not_numbers": watcher.not_numbers,
            "poses": len(watcher.poses),
            "leftovers": leftovers,
            "half_written": half,
            "tracebacks": log.count("Traceback"),
            "before": before,
            "after": after,
            "bars": bars(outcomes, well, code, watcher, leftovers, half, before, after),
        }


def one(kind: Kind, bench: Bench, watcher: Watcher, begun_s: float) -> Outcome:
    """Do it, undo it, wait until all is well, rest."""
    keyframes, epoch, exits = watcher.keyframes(), watcher.epoch, len(bench.service.exits)
    at = time.monotonic()
    with kind.fault(bench):
        time.sleep(kind.length_s)
    undone = time.monotonic()
    # A process that was hit is noticed within a moment, and then said to be unwell.
    time.sleep(1.0)
    recovered = _until_well(watcher, RECOVERED_S, watcher.far_poses if kind.far else None)
    time.sleep(bench.rng.uniform(2.0, 4.0))
    gap = watcher.longest_gap(at, time.monotonic(), watcher.far_poses if kind.far else None)
    length = undone - at
    return Outcome(
        kind=kind.name,
        at_s=round(at - begun_s, 2),
        length_s=round(length, 2),
        gap_s=round(gap, 3),
        beyond_s=round(max(gap - length, 0.0) if kind.stops else gap, 3),
        recovered_s=None if recovered is None else round(recovered - undone, 2),
        epochs=int(watcher.epoch > epoch),
        keyframes=(keyframes, watcher.keyframes()),
        new_run=kind.new_run,
        exits=len(bench.service.exits) - exits,
    )


def bars(
    outcomes: list[Outcome],
    well: bool,
    code: int | None,
    watcher: Watcher,
    leftovers: list[str],
    half: list[str],
    before: dict[str, Any],
    after: dict[str, Any],
) -> dict[str, dict[str, Any]]:
    """Each bar: what was found, and whether it is met."""
    beyond = [outcome.beyond_s for outcome in outcomes] or [0.0]
    lost = [o.kind for o in outcomes if o.epochs or _shrunk(*o.keyframes)]
    died = [o.kind for o in outcomes if o.exits and not o.new_run]
    ill = [o.kind for o in outcomes if o.recovered_s is None]
    more, gone = _more(before["descriptors"], after["descriptors"])
    slow = [o.kind for o in outcomes if o.beyond_s > LONGEST_S]
    median = statistics.median(beyond)
    found = {
        "ends healthy, and at SIGTERM with 0": (f"well: {well}, exit code {code}", well and code == 0),
        f"longest gap beyond a fault <= {LONGEST_S:g} s": (
            f"{max(beyond):.2f} s" + (f"; over: {', '.join(slow)}" if slow else ""), not slow
        ),
        f"median gap beyond a fault <= {MEDIAN_S:g} s": (f"{median:.2f} s", median <= MEDIAN_S),
        f"well again within {RECOVERED_S:g} s of each fault": (
            "not after " + ", ".join(ill) if ill else "always", not ill
        ),
        "no map lost": (", ".join(lost) or "none", not lost),
        "the service never ended of itself": (", ".join(died) or "never", not died),
        "no NaN published": (str(watcher.not_numbers), not watcher.not_numbers),
        "no file half written": (", ".join(half) or "none", not half),
        "no process, folder or shared memory left": (", ".join(leftovers) or "none", not leftovers),
        "no descriptors leaked": (
            ", ".join([f"{name} {n:+d}" for name, n in more.items()] + [f"{name} is gone" for name in gone]),
            not gone and max(more.values(), default=0) <= DESCRIPTORS,
        ),
    }
    return {name: {"found": text, "met": bool(met)} for name, (text, met) in found.items()}


def markdown(report: dict[str, Any]) -> str:
    """The report for people."""
    lines = [f"{len(report['outcomes'])} faults, seed {report['seed']}, camera at {report['rate_hz']:g} Hz."]
    lines += [f"Undisturbed, the longest gap in 5 s was {report['undisturbed_gap_s']:.2f} s."]
    pss = [sum(report[when]["pss_mb"].values()) for when in ("before", "after")]
    lines += [f"PSS at the start, with a small map: {pss[0]:.0f} MB; at the end: {pss[1]:.0f} MB."]
    lines += [""]
    lines += ["| bar | found | met |", "|---|---|---|"]
    lines += [
        f"| {name} | {bar['found']} | {'yes' if bar['met'] else '**no**'} |"
        for name, bar in report["bars"].items()
    ]
    lines += ["", "| fault | times | beyond, median (s) | longest (s) | new maps |", "|---|---|---|---|---|"]
    by_kind: dict[str, list[dict[str, Any]]] = {}
    for outcome in report["outcomes"]:
        by_kind.setdefault(outcome["kind"], []).append(outcome)
    for kind, those in sorted(by_kind.items()):
        beyond = [outcome["beyond_s"] for outcome in those]
        epochs = sum(outcome["epochs"] for outcome in those)
        lines.append(
            f"| {kind} | {len(those)} | {statistics.median(beyond):.2f} | {max(beyond):.2f} | {epochs} |"
        )
    lines += ["", *[f"Skipped: {what}: {why}." for what, why in report["skipped"].items()]]
    return "\n".join(lines).rstrip() + "\n"


def _more(before: dict[str, int], after: dict[str, int]) -> tuple[dict[str, int], list[str]]:
    """By how much each process's count has grown, and the processes that are there no more."""
    more = {name: after[name] - count for name, count in before.items() if name in after}
    return more, [name for name in before if name not in after]


def _shrunk(before: int, after: int) -> bool:
    """Whether a map has lost keyframes; -1: the backend was not there to ask, so there is no map.

    The trial's room has 20, of which some are stand-ins and go by themselves.
    """
    return before > 0 and after < 0.8 * before - 1


def _until_well(watcher: Watcher, within_s: float, poses: list[float] | None = None) -> float | None:
    """When everything is well; None if that is not so in time."""
    deadline = time.monotonic() + within_s
    while time.monotonic() < deadline:
        flows = poses is None or (bool(poses) and poses[-1] > time.monotonic() - 0.5)
        if watcher.well and flows:
            return time.monotonic()
        time.sleep(0.1)
    return None


def _truncate(server: MjpegServer, on: bool, rng: random.Random) -> None:
    """Cuts every third picture or so short."""
    server.mangle = (lambda data: data[: len(data) // 2] if rng.random() < 0.3 else data) if on else bytes


def _shared_memory() -> set[str]:
    """Names in /dev/shm; those of other programs that start meanwhile are among them."""
    folder = Path("/dev/shm")
    return {path.name for path in folder.glob("*")} if folder.is_dir() else set()


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))  # the daemon ends with us
    sys.exit(main())
