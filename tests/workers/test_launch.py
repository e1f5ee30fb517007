"""A worker alone from the command line: starts, gets ready, ends when told; and users' errors."""

from __future__ import annotations

import logging
import os
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from prism_edge.bus.session import Bus
from prism_edge.bus.vacancy import free_endpoint
from prism_edge.config import BusConfig, Config, DepthConfig, SourceConfig
from prism_edge.config_file import dump
from prism_edge.errors import BusError
from prism_edge.messages import IDS_A_LIFE, LARGEST_ID
from prism_edge.processes import PROCESSES
from prism_edge.workers.launch import joined, say_when_linked
from tests.sources.tiny_datasets import write_tum
from tests.synthetic.network import write_tiny_network
from tests.waiting import until

CHECKOUT = Path(__file__).resolve().parents[2]
DEADLINE_S = 60.0


def command(name: str, file: Path) -> list[str]:
    return [sys.executable, "-m", "prism_edge.workers", name, "--config", str(file)]


def run(name: str, file: Path) -> subprocess.CompletedProcess[str]:
    line = command(name, file)
    return subprocess.run(line, cwd=CHECKOUT, capture_output=True, text=True, timeout=DEADLINE_S)


@pytest.fixture
def config(tmp_path: Path) -> Config:
    (tmp_path / "tum").mkdir()
    recording = write_tum(tmp_path / "tum")
    model = write_tiny_network(tmp_path / "tiny.onnx")
    return Config(
        bus=BusConfig(free_endpoint()),
        source=SourceConfig(str(recording)),
        depth=DepthConfig(model=str(model)),
    )


@pytest.mark.parametrize("name", PROCESSES)
def test_each_process_runs_alone_and_ends_when_told(name: str, config: Config, tmp_path: Path) -> None:
    file = tmp_path / "effective.yaml"
    file.write_text(dump(config))
    log = tmp_path / "log"
    with Bus.open(config, "supervisor", listen=True) as bus, log.open("w") as stderr:
        beats = bus.queue("heartbeat")
        # As a supervisor's, in its first life: another waits for a backend that may know the map's unit.
        started = [*command(name, file), "--parent", str(os.getpid())]
        process = subprocess.Popen(started, cwd=CHECKOUT, stderr=stderr)
        try:
            end = time.monotonic() + DEADLINE_S
            beat = None
            while beat is None or beat.process != name or beat.state == "starting":
                assert time.monotonic() < end, "never ready"
                assert process.poll() is None, log.read_text()
                beat = beats.take(0.2)
            assert beat.pid == process.pid
            assert os.getpriority(os.PRIO_PROCESS, process.pid) == min(
                os.getpriority(os.PRIO_PROCESS, 0) + PROCESSES[name].nice, 19
            )
            # What writes a line in a terminal's background under `stty tostop` would be stopped.
            status = Path(f"/proc/{process.pid}/status").read_text()
            ignored = int(status.split("SigIgn:")[1].split()[0], 16)
            assert ignored >> (signal.SIGTTOU - 1) & 1
            assert os.readlink(f"/proc/{process.pid}/fd/1") == os.devnull
            process.send_signal(signal.SIGTERM)
            assert process.wait(DEADLINE_S) == 0
        finally:
            process.kill()
            process.wait()


@pytest.mark.parametrize(
    ("content", "code", "words"),
    [("robot: 5\n", 3, "robot: expected text"), ("bus:\n  endpoint: nonsense\n", 6, "nonsense")],
)
def test_users_error_is_one_line_and_its_code(content: str, code: int, words: str, tmp_path: Path) -> None:
    file = tmp_path / "config.yaml"
    file.write_text(content)
    ended = run("scale", file)
    assert ended.returncode == code
    assert ended.stderr.startswith("prism-edge scale: error: ")
    assert words in ended.stderr
    assert ended.stderr.count("\n") == 1


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")
@pytest.mark.parametrize("nobody", ["full", "gone"])
def test_users_error_has_its_code_though_nobody_can_be_told(nobody: str, tmp_path: Path) -> None:
    file = tmp_path / "config.yaml"
    file.write_text("robot: 5\n")
    read, gone = os.pipe()
    os.close(read)
    with open("/dev/full", "w") as full, os.fdopen(gone, "w") as pipe:
        line = command("scale", file)
        ended = subprocess.run(
            line, cwd=CHECKOUT, stderr=full if nobody == "full" else pipe, timeout=DEADLINE_S
        )
    assert ended.returncode == 3


@pytest.mark.parametrize(("by_hand", "life"), [(False, 0), (False, 2), (True, 0)])
def test_a_life_numbers_things_beyond_those_before_it(by_hand: bool, life: int, tmp_path: Path) -> None:
    """Nobody counts the lives of a worker that was started by hand: the clock does."""
    file = tmp_path / "config.yaml"
    file.write_text(dump(Config()))
    say = "import sys; from prism_edge.processes import PROCESSES\n"
    say += "from prism_edge.workers import launch, scale\n"
    say += "scale.main = lambda config, bus: open(sys.argv[2], 'w').write(f'{bus.life} {bus.first_id}')\n"
    say += f"launch.run_worker(PROCESSES['scale'], sys.argv[1], {None if by_hand else os.getpid()}, {life})"
    before = time.time_ns() // 1000
    told = tmp_path / "told"
    line = [sys.executable, "-c", say, str(file), str(told)]
    subprocess.run(line, cwd=CHECKOUT, capture_output=True, timeout=DEADLINE_S)
    counted, first = map(int, told.read_text().split())
    assert counted == life
    if by_hand:
        assert before < first < LARGEST_ID
    else:
        assert first == life * IDS_A_LIFE


def test_by_hand_it_says_that_nobody_listens_and_when_somebody_does(
    config: Config, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    config = replace(config, bus=replace(config.bus, retry_ms=50))
    log = logging.getLogger("prism_edge.scale")
    with Bus.open(config, "scale") as bus:
        saying = threading.Thread(target=say_when_linked, args=(bus, config.bus.endpoint, log))
        saying.start()
        end = time.monotonic() + DEADLINE_S
        while not caplog.messages and time.monotonic() < end:
            time.sleep(0.02)
        assert caplog.messages == [f"waiting for a listener at {config.bus.endpoint}"]
        with Bus.open(config, "supervisor", listen=True):
            saying.join(DEADLINE_S)
            say_when_linked(bus, config.bus.endpoint, log)  # at once, where there is a link
    assert caplog.messages[1:] == [f"on the bus at {config.bus.endpoint}"] * 2


def test_by_hand_it_begins_anew_with_the_robots_next_run(config: Config, tmp_path: Path) -> None:
    """It outlives the robot's daemon, which numbers its next run's keyframes from 0 again."""
    file, log = tmp_path / "effective.yaml", tmp_path / "log"
    config = replace(config, bus=replace(config.bus, retry_ms=50))
    file.write_text(dump(config))
    words = "depth: the robot has begun another run: beginning anew"
    with log.open("w") as stderr:
        process = subprocess.Popen(command("depth", file), cwd=CHECKOUT, stderr=stderr)
        try:
            for run in range(3):
                with Bus.open(config, "supervisor", listen=True) as bus:
                    until(lambda run=run: log.read_text().count(words) == run, f"run {run}", DEADLINE_S)
                    assert bus.await_ready(["depth"], DEADLINE_S) == set()
            process.send_signal(signal.SIGTERM)
            assert process.wait(DEADLINE_S) == 0
            assert log.read_text().count("runs on CPUExecutionProvider") == 3
            assert "without being told" not in log.read_text()
        finally:
            process.kill()
            process.wait()


def test_what_the_last_run_brought_it_to_does_not_end_it(config: Config, tmp_path: Path) -> None:
    """As where a message of the next run was at it before it knew that this is another."""
    file, told = tmp_path / "config.yaml", tmp_path / "told"
    file.write_text(dump(replace(config, bus=replace(config.bus, retry_ms=50))))
    say = "import sys; from prism_edge.processes import PROCESSES\n"
    say += "from prism_edge.workers import launch, scale\n"
    say += "def main(config, bus):\n"
    say += "    with open(sys.argv[2], 'a') as told: told.write('begun ')\n"
    say += "    bus.pulse.ready(); bus.stopped.wait(60.0); raise KeyError(16)\n"
    say += "scale.main = main\n"
    say += "sys.exit(launch.run_worker(PROCESSES['scale'], sys.argv[1]))"
    line = [sys.executable, "-c", say, str(file), str(told)]
    process = subprocess.Popen(line, cwd=CHECKOUT, stderr=subprocess.PIPE, text=True)
    try:
        for lives in ("begun ", "begun begun "):
            with Bus.open(config, "supervisor", listen=True) as bus:
                until(lambda lives=lives: told.exists() and told.read_text() == lives, lives, DEADLINE_S)
                assert bus.await_ready(["scale"], DEADLINE_S) == set()
        process.send_signal(signal.SIGTERM)
        assert process.wait(DEADLINE_S) == 70, "an error of this run is one"
    finally:
        process.kill()
        _, said = process.communicate()
    assert told.read_text() == "begun begun "
    assert "the last run's work ended with KeyError: 16" in said


def test_a_run_that_is_down_is_waited_for_once_there_was_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """From another host the bus is only opened where somebody listens."""
    answers: list[object] = []

    def opened(config: Config, name: str) -> object:
        answer = answers.pop(0)
        if answer is None:
            raise BusError("nobody answers")
        return answer

    monkeypatch.setattr(Bus, "open", opened)
    monkeypatch.setattr("prism_edge.workers.launch._LINKED_S", 0.01)
    signals = SimpleNamespace(stopped=threading.Event())
    answers[:] = [None, None, "a bus"]
    assert joined(Config(), "depth", signals, is_again=True) == "a bus"
    answers[:] = [None]
    with pytest.raises(BusError, match="nobody answers"):
        joined(Config(), "depth", signals, is_again=False)
    signals.stopped.set()
    answers[:] = [None]
    assert joined(Config(), "depth", signals, is_again=True) is None


def test_a_life_s_numbers_last_for_months() -> None:
    points_a_second, day_s = 1_000, 86_400
    assert points_a_second * day_s * 100 < IDS_A_LIFE
    assert 1_000_000 * IDS_A_LIFE < LARGEST_ID


def test_unknown_name_is_refused(tmp_path: Path) -> None:
    ended = run("pilot", tmp_path / "c.yaml")
    assert ended.returncode == 2
    assert "pilot" in ended.stderr


STARVED = """
import sys, threading, types
import numpy as np
from prism_edge.processes import Process
from prism_edge.workers.launch import run_worker

def main(config, bus):
    threading.Thread.start = lambda thread: threading.Event().wait()  # as where the new one finds no memory
    {fails}

sys.modules["starving"] = types.SimpleNamespace(main=main)
sys.exit(run_worker(Process("scale", "starving", "nothing", False), sys.argv[1], parent={parent}))
"""


@pytest.mark.parametrize(
    ("fails", "starved"), [("raise MemoryError", True), ("np.zeros(1 << 50)", False), ("1 / 0", False)]
)
def test_what_finds_no_memory_ends_without_leaving_anything_in_order(
    fails: str, starved: bool, config: Config, tmp_path: Path
) -> None:
    """One array that is too large, or any other error, is told of with its lines; none waits for a thread."""
    file = tmp_path / "c.yaml"
    file.write_text(dump(config))
    with Bus.open(config, "supervisor", listen=True):
        program = STARVED.format(fails=fails, parent=os.getpid())
        worker = subprocess.Popen(
            [sys.executable, "-c", program, str(file)], cwd=CHECKOUT, stderr=subprocess.PIPE, text=True
        )
        try:
            _, said = worker.communicate(timeout=DEADLINE_S)
        finally:
            worker.kill()
    assert worker.returncode == 70
    assert ("prism-edge scale failed: MemoryError" in said) == starved
    assert ("unexpected error" in said) == (not starved)
