"""More than one machine: a depth worker on another host, and a fleet of robots behind one router.

    sudo python tools/fleet_trial.py [--out build/fleet] [--cut-s 30]

The first part has three network namespaces, so root and `ip` are needed: robot, wire and depth host. The wire
adds delay and loss (tools/faults_relay.py); then its far end is taken down. Tracking must go on, the scale's
uncertainty must grow, and the link must heal by itself. The second part needs no rights: ten simulated
robots' publishers, one router, and a subscriber that joins late. Writes report.json; the exit code is 1 where
anything fails.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import zenoh

from prism_edge.bus import ros
from prism_edge.bus.session import Bus
from prism_edge.bus.vacancy import free_endpoint
from prism_edge.config import BusConfig, Config, NetworkConfig
from prism_edge.config_file import dump
from tools.faults_service import (
    ROOT,
    Room,
    Service,
    Watcher,
    client_session,
    draw_room,
    long_recording,
    one_run,
    service_config,
    start_router,
)

ROBOTS = 10
DELAY_S, LOSS = 0.05, 0.01
ROBOT, NEAR, FAR, HOST = "10.77.1.1", "10.77.1.2", "10.77.2.2", "10.77.2.1"
PORT = 7448


def main(arguments: list[str] | None = None) -> int:
    """Both parts; returns the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("build/fleet"), help="folder of the report")
    parser.add_argument("--cut-s", type=float, default=30.0)
    parser.add_argument("--inside", metavar="WIRE,HOST", help=argparse.SUPPRESS)  # the robot's part of it
    args = parser.parse_args(arguments)
    args.out.mkdir(parents=True, exist_ok=True)
    if args.inside:
        wire, host = args.inside.split(",")
        print(json.dumps(remote_depth(wire, host, args.cut_s, args.out)))
        return 0
    report: dict[str, Any] = {"fleet": fleet()}
    with namespaces() as names:
        if names is None:
            report["remote depth"] = {"skipped": "network namespaces are not permitted here"}
        else:
            robot, wire, host = names
            line = ["ip", "netns", "exec", robot, sys.executable, __file__, "--out", str(args.out)]
            line += ["--cut-s", str(args.cut_s), "--inside", f"{wire},{host}"]
            done = subprocess.run(line, capture_output=True, text=True)
            if done.returncode:
                report["remote depth"] = {"checks": {"runs": [done.stderr[-500:], False]}}
            else:
                report["remote depth"] = json.loads(done.stdout.splitlines()[-1])
    (args.out / "report.json").write_text(json.dumps(report, indent=1) + "\n")
    good = True
    for part, values in report.items():
        for name, (found, met) in values.get("checks", {}).items():
            good &= met
            print(f"{'ok  ' if met else 'FAIL'}  {part}: {name}: {found}")
        if "skipped" in values:
            print(f"skip  {part}: {values['skipped']}")
    return 0 if good else 1


@contextlib.contextmanager
def namespaces() -> Iterator[tuple[str, str, str] | None]:
    """robot - wire - host, joined by two pairs of virtual interfaces; None where that is not allowed."""
    names = tuple(f"prism-{os.getpid()}-{role}" for role in ("robot", "wire", "host"))
    robot, wire, host = names
    lines = [f"ip netns add {name}" for name in names] + [f"ip -n {name} link set lo up" for name in names]
    for end, near, far, ours, theirs in (
        (robot, "near", "wire0", ROBOT, NEAR),
        (host, "far", "wire1", HOST, FAR),
    ):
        lines += [
            f"ip link add {near} netns {end} type veth peer name {far} netns {wire}",
            f"ip -n {end} addr add {ours}/24 dev {near}",
            f"ip -n {wire} addr add {theirs}/24 dev {far}",
            f"ip -n {end} link set {near} up",
            f"ip -n {wire} link set {far} up",
        ]
    try:
        permitted = all(subprocess.run(line.split(), capture_output=True).returncode == 0 for line in lines)
        yield (robot, wire, host) if permitted else None
    except FileNotFoundError:
        yield None
    finally:
        with contextlib.suppress(FileNotFoundError):
            for name in names:
                subprocess.run(["ip", "netns", "del", name], capture_output=True)


def remote_depth(wire: str, host: str, cut_s: float, out: Path) -> dict[str, Any]:
    """The robot's side, run inside its namespace."""
    checks: dict[str, tuple[str, bool]] = {}
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="prism-edge-fleet-")))
        room = draw_room(folder)
        recording = long_recording(room, folder / "long")
        config = service_config(str(recording), room, folder / "state", loop=True)
        network = NetworkConfig(endpoint=f"tcp/{ROBOT}:{PORT}", remote=("depth",))
        config = replace(config, network=network)
        service = stack.enter_context(Service(folder, config))
        stack.callback(lambda: (out / "robot.log").write_bytes(service.log.read_bytes()))
        relay = [str(ROOT / "tools" / "faults_relay.py"), f"{FAR}:{PORT}", f"{ROBOT}:{PORT}"]
        _in(stack, wire, *relay, "--delay", str(DELAY_S), "--loss", str(LOSS))
        time.sleep(2.0)  # a client of another host wants the listener to be there
        _depth_host(stack, folder, host, room, out)
        watcher = Watcher(config)
        stack.callback(watcher.close)
        scales = watcher.bus.queue("scale", 4096)
        _await("poses and depth over the wire", lambda: watcher.well and _fresh(watcher), 60.0)
        time.sleep(8.0)
        before = _last(scales)
        began = time.monotonic()
        subprocess.run(["ip", "-n", wire, "link", "set", "wire1", "down"], check=True)
        time.sleep(cut_s)
        said = watcher.health["depth"]
        poses = sum(at > began + 1.0 for at in watcher.poses) / (cut_s - 1.0)
        gap = watcher.longest_gap(began, time.monotonic())
        # What was on its way when the link went counts as heard before.
        heard = [before, *scales.drain()]
        before, during = [message for message in heard if message.points][-1], heard[-1]
        keyframes = watcher.keyframes()
        subprocess.run(["ip", "-n", wire, "link", "set", "wire1", "up"], check=True)
        up = time.monotonic()
        with contextlib.suppress(TimeoutError):
            _await("the link", lambda: _fresh(watcher), 60.0)
        healed = time.monotonic() - up
        after = _await("a scale from new depth", lambda: _last(scales, observed=True), 30.0)
        checks["poses during the cut, a second"] = (f"{poses:.1f}", poses > 20.0)
        checks["longest gap in poses (s)"] = (f"{gap:.2f}", gap < 1.0)
        checks["health says that depth is not heard"] = (said["message"], said["level"] == "2")
        sigmas = [message.filter_sigma_log for message in (before, during, after)]
        checks["sigma of log scale before, at the end of the cut, after"] = (
            ", ".join(f"{sigma:.4f}" for sigma in sigmas), sigmas[1] > sigmas[0]
        )
        checks["healed by itself after (s)"] = (f"{healed:.1f}", healed < 30.0)
        checks["map goes on (keyframes)"] = (str(keyframes), keyframes > 0)
        checks["NaN published"] = (str(watcher.not_numbers), watcher.not_numbers == 0)
        code = service.stop()
        checks["one run, that ends with 0"] = one_run(service.exits, code)
    return {"delay_s": DELAY_S, "loss": LOSS, "cut_s": cut_s, "checks": checks}


def _depth_host(stack: contextlib.ExitStack, folder: Path, host: str, room: Room, out: Path) -> None:
    own = replace(Config(), bus=BusConfig(f"tcp/{FAR}:{PORT}"))
    own = replace(own, depth=replace(own.depth, model=str(room.network)))
    file = folder / "depth.yaml"
    file.write_text(dump(own))
    with (out / "depth.log").open("wb") as log:
        _in(stack, host, "-m", "prism_edge.cli", "worker", "depth", "--config", str(file), output=log)


def _in(stack: contextlib.ExitStack, namespace: str, *line: str, output: Any = subprocess.DEVNULL) -> None:
    """Python in a namespace, until the stack is left."""
    popen = subprocess.Popen(
        ["ip", "netns", "exec", namespace, sys.executable, *line],
        cwd=ROOT, stdin=subprocess.DEVNULL, stdout=output, stderr=output,
    )
    stack.callback(popen.wait)
    stack.callback(popen.kill)


def _fresh(watcher: Watcher) -> bool:
    """Whether the supervisor hears the remote depth worker."""
    return watcher.health.get("depth", {}).get("level") in ("0", "1")


def _last(inbox: Any, observed: bool = False) -> Any:
    messages = [message for message in inbox.drain() if message.points or not observed]
    return messages[-1] if messages else None


def _await(what: str, condition: Any, within_s: float) -> Any:
    deadline = time.monotonic() + within_s
    while not (found := condition()):
        if time.monotonic() > deadline:
            raise TimeoutError(f"waited {within_s:g} s in vain for {what}")
        time.sleep(0.05)
    return found


def fleet() -> dict[str, Any]:
    """Ten robots' publishers, one router, one subscriber of all, and one that comes late."""
    checks: dict[str, tuple[str, bool]] = {}
    with contextlib.ExitStack() as stack:
        buses, endpoints = [], []
        for number in range(ROBOTS):
            config = replace(Config(), robot=f"robot{number}", bus=BusConfig(free_endpoint(), retry_ms=100))
            endpoints.append(config.bus.endpoint)
            stack.enter_context(Bus.open(config, "supervisor", listen=True))
            buses.append(stack.enter_context(Bus.open(config, "tracker")))
        listen = free_endpoint()
        router = start_router(listen, *endpoints)
        heard: dict[str, int] = {}

        def hear(sample: Any) -> None:
            robot = str(sample.key_expr).split("/")[1]
            heard[robot] = heard.get(robot, 0) + 1

        session = stack.enter_context(client_session(listen))
        subscriber = session.declare_subscriber("prism/*/status", hear)

        def publish(rounds: int) -> None:
            for count in range(rounds):
                for bus in buses:
                    rows = [("tracker", 0, "ok building", {"n": str(count)})]
                    bus.publish("status", ros.diagnostics(time.time_ns(), rows))
                time.sleep(1.0 / 30.0)

        deadline = time.monotonic() + 20.0
        while len(heard) < ROBOTS and time.monotonic() < deadline:
            publish(5)
        time.sleep(0.3)
        heard.clear()
        publish(90)
        time.sleep(0.5)
        checks["messages of 90 each, by robot"] = (
            f"{sorted(heard.values())}", len(heard) == ROBOTS and min(heard.values()) == 90
        )
        late_s, replies = _late(listen)
        checks["a late subscriber has every robot's state"] = (
            f"{replies} of {ROBOTS} after {1e3 * late_s:.0f} ms", replies == ROBOTS and late_s < 2.0
        )
        router.kill()
        router.wait()
        router = start_router(listen, *endpoints)
        began = time.monotonic()
        heard.clear()
        while len(heard) < ROBOTS and time.monotonic() < began + 30.0:
            publish(1)
        checks["all robots heard again after the router's restart (s)"] = (
            f"{time.monotonic() - began:.1f}", len(heard) == ROBOTS
        )
        subscriber.undeclare()
        router.kill()
        router.wait()
    return {"robots": ROBOTS, "checks": checks}


def _late(listen: str) -> tuple[float, int]:
    """Seconds from joining to the last answer, and how many robots answered."""
    began = time.monotonic()
    with client_session(listen) as session:
        none = zenoh.ConsolidationMode.NONE
        replies = session.get("prism/*/status", timeout=3.0, consolidation=none)
        names = {str(reply.ok.key_expr) for reply in replies if reply.ok is not None}
        return time.monotonic() - began, len(names)


if __name__ == "__main__":
    sys.exit(main())
