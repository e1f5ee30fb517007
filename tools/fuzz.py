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
from dataclasses import replace
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from prism_edge.bus.links import open_session
from prism_edge.topics import COMMANDS
from tests.sources.live.servers import mjpeg_server
from tools.faults_service import ROOT, Service, Watcher, draw_room, service_config
from tools.fuzz_files import mutate
from tools.fuzz_messages import damaged, example, topics

LIVE_SHARE = 0.12  # of the inputs go into the running daemon
CLI_EACH = 4  # files of each kind that the command line is given, as a user would
QUERY_S = 2.0
MAD = 30  # messages that are sound but for their values, at most
WELL_S = 60.0  # within which all must be well again


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
        said, code, errors = _text(expired.stdout), -1, "one input was not done with in two minutes"
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


def _text(said: str | bytes | None) -> str:
    """What a process had said when its time was up: bytes on Linux, even where text was asked for."""
    return said.decode(errors="replace") if isinstance(said, bytes) else said or ""


def command_line(folder: Path, seed: int) -> dict[str, Any]:
    """A few damaged files as a user would give them: taken, or refused in one line with its exit code."""
    rng, found, inputs = random.Random(seed), [], 0
    config = b"robot: rover\ntracking:\n  features: 700\nsource: {uri: none, loop: true}\n"
    for _ in range(CLI_EACH):
        for name, sound, options, codes in (
            ("c.yaml", config, ("config", "--check"), (0, 3)),
            ("net.onnx", (folder / "files" / "sound.onnx").read_bytes(), ("models", "info"), (0, 5)),
            ("run.yaml", config, ("run", "--config"), (3, 4, 5, 6)),
        ):
            path = folder / name
            path.write_bytes(mutate(sound, rng))
            inputs += 1
            line = [sys.executable, "-m", "prism_edge.cli", *options, str(path)]
            try:
                done = subprocess.run(line, cwd=ROOT, capture_output=True, text=True, timeout=60.0)
            except subprocess.TimeoutExpired:
                found.append({"case": "command line", "what": f"{' '.join(options)} did not end"})
                continue
            if what := misbehaved(done, codes):
                found.append({"case": "command line", "what": f"{' '.join(options)}: {what}"})
    return {"inputs": inputs, "found": found}


def misbehaved(done: subprocess.CompletedProcess[str], codes: tuple[int, ...]) -> str | None:
    """What is wrong with how a command ended that was to end with one of ``codes`` (`prism-edge --help`)."""
    if "Traceback" in done.stderr or done.returncode not in codes:
        return f"exit code {done.returncode}: {done.stderr[-300:]}"
    said = [line for line in done.stderr.splitlines() if not line.startswith("prism-edge: warning: ")]
    if done.returncode and len(said) != 1:
        return f"{len(said)} lines with exit code {done.returncode}: {done.stderr[-300:]}"
    return None


def daemon(folder: Path, count: int, seed: int, budget_s: float, out: Path) -> dict[str, Any]:
    """Queries, messages, maps and camera bytes to a daemon that tracks meanwhile."""
    rng = random.Random(seed + 1)
    room = draw_room(folder)
    run = folder / "run"
    run.mkdir()
    inputs = {"queries": 0, "messages": 0, "map files": 0, "camera bytes": 0, "mad messages": 0}
    found: list[dict[str, str]] = []
    with contextlib.ExitStack() as stack:
        server = stack.enter_context(mjpeg_server())
        server.period_s = 0.05
        server.picture = lambda k: room.pictures[k % len(room.pictures)]
        config = service_config(server.address(), room, run / "state")
        # Mad messages come faster than processes may die.
        patient = replace(config.supervisor, max_restarts=1000, window_s=1.0)
        config = replace(config, supervisor=patient)
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

        def cut_up(data: bytes) -> bytes:
            if rng.random() < 0.1:
                inputs["camera bytes"] += 1
                return mutate(data, rng)
            return data

        server.mangle = cut_up
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
                _query(session, rng, run)
            else:
                inputs["messages"] += 1
                topic = rng.choice(topics())
                session.put(f"prism/robot/{topic.key}", damaged(topic.type, rng))
        server.mangle = bytes
        for switch in ("pause", "localise_only"):  # a query may have thrown them
            _command(session, switch, "off")
        if not _well_within(watcher, WELL_S):
            found.append({"case": "daemon", "what": f"no poses afterwards: {watcher.health}"})
        for name, row in watcher.health.items():
            if row.get("restarts", "0") != restarts.get(name, "0"):
                found.append({"case": "daemon", "what": f"{name} died: {row.get('last_exit')}"})
        tracebacks = service.log.read_text(errors="replace").count("Traceback")
        if tracebacks:
            found.append({"case": "daemon", "what": f"{tracebacks} tracebacks in its log"})
        while inputs["mad messages"] < min(MAD, count // 10) and time.monotonic() < deadline:
            topic = rng.choice(topics(heard=True))
            inputs["mad messages"] += 1
            session.put(f"prism/robot/{topic.key}", example(topic.type, rng))
            time.sleep(1.0)  # a process that dies of it is noticed within a moment
            if not _well_within(watcher, WELL_S):
                found.append({"case": "daemon", "what": f"no poses after {topic.key}: {watcher.health}"})
                break
        if watcher.not_numbers:
            found.append({"case": "daemon", "what": f"{watcher.not_numbers} poses with NaN"})
        state = str(run / "state")
        new = [p for p in _files(run) - before if not p.startswith(state) and "/runtime/" not in p]
        found += [{"case": "daemon", "what": f"written outside: {path}"} for path in new]
        code = service.stop()
        if code != 0 or service.exits:
            found.append({"case": "daemon", "what": f"ended with {service.exits}, at last {code}"})
    return {"inputs": inputs, "found": found}


def _command(session: Any, name: str, argument: str) -> None:
    payload = json.dumps({"argument": argument}).encode()
    list(session.get(f"prism/robot/command/{name}", payload=payload, timeout=10.0))


def _query(session: Any, rng: random.Random, run: Path) -> None:
    """One damaged command; each is a query that a client might send."""
    command = rng.choice(list(COMMANDS))
    names = ["../../x", str(run / "x"), "", ".", "a" * 300, "a\0b", "no-map"]
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
