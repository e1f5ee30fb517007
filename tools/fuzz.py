"""Malformed inputs by the thousand: files into every parser, queries and camera bytes into a daemon.

    python tools/fuzz.py [--count 10000] [--seed 0] [--budget-s 600] [--out build/fuzz]

Counts crashes, tracebacks, processes that had to be started again, and files written where none should be.
Writes report.json and report.md; the exit code is 1 where anything was found.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import logging
import random
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from prism_edge.bus.links import open_session
from prism_edge.topics import COMMANDS, TOPICS
from tests.sources.live.servers import mjpeg_server
from tools.faults_service import ROOT, Service, Watcher, draw_room, service_config
from tools.fuzz_files import mutate

LIVE_SHARE = 0.12  # of the inputs go into the running daemon
CLI_EACH = 4  # files of each kind that the command line is given, as a user would
QUERY_S = 2.0


def main(arguments: list[str] | None = None) -> int:
    """Feed, count, report; returns the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--count", type=int, default=10_000, help="inputs (default 10000)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--budget-s", type=float, default=600.0, help="stop after so many seconds")
    parser.add_argument("--out", type=Path, default=Path("build/fuzz"), help="folder of the report")
    args = parser.parse_args(arguments)
    args.out.mkdir(parents=True, exist_ok=True)
    logging.getLogger("prism_edge.bus").setLevel(logging.ERROR)  # our own subscriber hears the malformed too
    with tempfile.TemporaryDirectory(prefix="prism-edge-fuzz-") as name:
        folder = Path(name)
        live = round(LIVE_SHARE * args.count)
        report = files(folder, args.count - live, args.seed, 0.55 * args.budget_s, args.out)
        report["cli"] = command_line(folder, args.seed)
        report["live"] = daemon(folder, live, args.seed, 0.35 * args.budget_s, args.out)
    total = sum(c["inputs"] for c in report["counts"].values()) + report["cli"]["inputs"]
    report["inputs"] = total + sum(report["live"]["inputs"].values())
    report["found"] += report["cli"]["found"] + report["live"]["found"]
    (args.out / "report.json").write_text(json.dumps(report, indent=1) + "\n")
    text = markdown(report)
    (args.out / "report.md").write_text(text)
    print(text)
    return 1 if report["found"] else 0


def files(folder: Path, count: int, seed: int, budget_s: float, out: Path) -> dict[str, Any]:
    """Inputs to the parsers, in processes of their own: one that crashes is followed by another."""
    report: dict[str, Any] = {"found": [], "counts": {}, "crashes": 0}
    own = folder / "files"
    own.mkdir()
    script = str(ROOT / "tools" / "fuzz_files.py")
    line = [sys.executable, script, str(seed), str(count), str(budget_s), str(own)]
    try:
        done = subprocess.run(line, cwd=own, capture_output=True, text=True, timeout=budget_s + 120.0)
        said, code, errors = done.stdout, done.returncode, done.stderr
    except subprocess.TimeoutExpired as expired:
        said, code, errors = str(expired.stdout or ""), -1, "one input was not done with in two minutes"
    for item in map(json.loads, said.splitlines()):
        if "counts" in item:
            report["counts"] = item["counts"]
        else:
            report["found"].append(item)
            kept = own / f"found-{item['number']}"
            if kept.exists():
                shutil.copy(kept, out)
    if code:
        report["crashes"] = 1
        report["found"].append({"case": "files", "what": f"exit code {code}: {errors[-400:]}"})
        with contextlib.suppress(OSError):
            shutil.copy(own / "last", out)
    return report


def command_line(folder: Path, seed: int) -> dict[str, Any]:
    """A few damaged files as a user would give them: one line, a documented exit code, no traceback."""
    rng, found, inputs = random.Random(seed), [], 0
    config = b"robot: rover\ntracking:\n  features: 700\nsource: {uri: none, loop: true}\n"
    for _ in range(CLI_EACH):
        for name, example, options in (
            ("c.yaml", config, ("config", "--check")),
            ("net.onnx", (folder / "files" / "sound.onnx").read_bytes(), ("models", "info")),
            ("run.yaml", config, ("run", "--config")),
        ):
            path = folder / name
            path.write_bytes(mutate(example, rng))
            inputs += 1
            line = [sys.executable, "-m", "prism_edge.cli", *options, str(path)]
            try:
                done = subprocess.run(line, cwd=ROOT, capture_output=True, text=True, timeout=60.0)
            except subprocess.TimeoutExpired:
                found.append({"case": "command line", "what": f"{' '.join(options)} did not end"})
                continue
            if done.returncode < 0 or "Traceback" in done.stderr:
                found.append({"case": "command line", "what": f"{options}: {done.stderr[-300:]}"})
    return {"inputs": inputs, "found": found}


def daemon(folder: Path, count: int, seed: int, budget_s: float, out: Path) -> dict[str, Any]:
    """Queries, messages, maps and camera bytes to a daemon that tracks meanwhile."""
    rng = random.Random(seed + 1)
    room = draw_room(folder)
    run = folder / "run"
    run.mkdir()
    inputs = {"queries": 0, "messages": 0, "map files": 0, "camera bytes": 0}
    found: list[dict[str, str]] = []
    with contextlib.ExitStack() as stack:
        server = stack.enter_context(mjpeg_server())
        server.period_s = 0.05
        server.picture = lambda k: room.pictures[k % len(room.pictures)]
        config = service_config(server.address(), room, run / "state")
        service = stack.enter_context(Service(run, config))
        stack.callback(lambda: (out / "daemon.log").write_bytes(service.log.read_bytes()))
        watcher = Watcher(config)
        stack.callback(watcher.close)
        if not _well_within(watcher, 120.0):
            raise SystemExit(f"fuzz: error: no poses in two minutes; see {out / 'daemon.log'}")
        session = stack.enter_context(open_session(config.bus, listen=False, client=True))
        restarts = {name: row.get("restarts", "0") for name, row in watcher.health.items()}
        _command(session, "save_map", "sound")
        sound = (run / "state" / "maps" / "sound.prismmap").read_bytes()
        before = _files(run)

        def damage(data: bytes) -> bytes:
            if rng.random() < 0.1:
                inputs["camera bytes"] += 1
                return mutate(data, rng)
            return data

        server.mangle = damage
        deadline = time.monotonic() + budget_s
        for number in range(count):
            if time.monotonic() > deadline:
                break
            if number % 100 == 99:  # each load unpacks a whole map
                inputs["map files"] += 1
                (run / "state" / "maps" / "bad.prismmap").write_bytes(mutate(sound, rng))
                _command(session, "load_map", "bad")
            elif number % 3:
                inputs["queries"] += 1
                _query(session, rng)
            else:
                inputs["messages"] += 1
                topic = rng.choice([t for t in TOPICS.values() if t.key != "internal/heartbeat"])
                session.put(f"prism/robot/{topic.key}", mutate(b"PRSM" + rng.randbytes(40), rng))
        server.mangle = bytes
        for switch in ("pause", "localise_only"):  # a query may have thrown them
            _command(session, switch, "off")
        if not _well_within(watcher, 60.0):
            found.append({"case": "daemon", "what": f"no poses afterwards: {watcher.health}"})
        for name, row in watcher.health.items():
            if row.get("restarts", "0") != restarts.get(name, "0"):
                found.append({"case": "daemon", "what": f"{name} died: {row.get('last_exit')}"})
        if watcher.not_numbers:
            found.append({"case": "daemon", "what": f"{watcher.not_numbers} poses with NaN"})
        state = str(run / "state")
        new = [p for p in _files(run) - before if not p.startswith(state) and "/runtime/" not in p]
        found += [{"case": "daemon", "what": f"written outside: {path}"} for path in new]
        code = service.stop()
        if code != 0 or service.exits:
            found.append({"case": "daemon", "what": f"ended with {service.exits}, at last {code}"})
        tracebacks = service.log.read_text(errors="replace").count("Traceback")
        if tracebacks:
            found.append({"case": "daemon", "what": f"{tracebacks} tracebacks in its log"})
    return {"inputs": inputs, "found": found}


def _command(session: Any, name: str, argument: str) -> None:
    payload = json.dumps({"argument": argument}).encode()
    list(session.get(f"prism/robot/command/{name}", payload=payload, timeout=10.0))


def _query(session: Any, rng: random.Random) -> None:
    """One damaged command; each is a query that a client might send."""
    command = rng.choice(list(COMMANDS))
    names = ["../../x", "/x", "", ".", "a" * 300, "a\0b", "no-map"]
    payload = rng.choice(
        (
            mutate(b'{"argument": "on"}', rng),
            json.dumps({"argument": rng.choice(names)}).encode(),
            rng.randbytes(rng.randrange(6000)),
        )
    )
    if command in ("reset", "pause") and rng.random() < 0.9:
        command = "info"  # a sound one of these is no malformed input, and ends what is watched
    list(session.get(f"prism/robot/command/{command}", payload=payload, timeout=QUERY_S))


def _files(folder: Path) -> set[str]:
    return {str(path) for path in folder.rglob("*") if path.is_file()}


def _well_within(watcher: Watcher, seconds: float) -> bool:
    deadline = time.monotonic() + seconds
    while not watcher.well and time.monotonic() < deadline:
        time.sleep(0.1)
    return watcher.well


def markdown(report: dict[str, Any]) -> str:
    """The report for people."""
    lines = [f"{report['inputs']} malformed inputs, {len(report['found'])} findings.", ""]
    lines += ["| input | fed | refused in one line | accepted |", "|---|---|---|---|"]
    for case, n in report["counts"].items():
        lines.append(f"| {case} | {n['inputs']} | {n['refused']} | {n['accepted']} |")
    lines.append(f"| command line | {report['cli']['inputs']} | | |")
    lines += [f"| running daemon: {name} | {n} | | |" for name, n in report["live"]["inputs"].items()]
    lines += ["", *[f"- {item['case']}: {item['what']}" for item in report["found"]]]
    return "\n".join(lines).rstrip() + "\n"


if __name__ == "__main__":
    sys.exit(main())
