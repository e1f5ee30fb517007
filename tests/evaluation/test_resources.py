"""Readings of CPU time and memory against what a child process knows of itself."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import psutil
import pytest

from prism_edge.evaluation import resources
from prism_edge.evaluation.resources import Meter, cpu_s, machine_cpu, pss_mb, taken_by_others

pytestmark = pytest.mark.skipif(not Path("/proc/self/smaps_rollup").exists(), reason="needs Linux's /proc")

# Says `ready PID OF ITS OWN CHILD`; then each line of input is evaluated and answered.
CHILD = """
import subprocess, sys, time
inner = None
def burn(seconds):
    end = time.process_time() + seconds
    while time.process_time() < end: pass
    return time.process_time()
def start():
    global inner
    pipe = subprocess.PIPE
    inner = subprocess.Popen([sys.executable, "-c", INNER], stdin=pipe, stdout=pipe, text=True)
    inner.stdout.readline()
    return inner.pid
def finish():
    inner.stdin.close()
    return inner.wait()
INNER = '''
import sys, time
while time.process_time() < 0.3: pass
print("burnt", flush=True)
sys.stdin.read()
'''
print("ready", flush=True)
for line in sys.stdin:
    print(eval(line), flush=True)
"""


class Child:
    """A process that burns CPU time and takes memory when told."""

    def __init__(self) -> None:
        self.popen = subprocess.Popen(
            [sys.executable, "-c", CHILD], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        self.pid = self.popen.pid
        self.answer()

    def answer(self) -> str:
        assert self.popen.stdout is not None
        return self.popen.stdout.readline().strip()

    def ask(self, expression: str) -> str:
        assert self.popen.stdin is not None
        self.popen.stdin.write(expression + "\n")
        self.popen.stdin.flush()
        return self.answer()


@contextmanager
def child() -> Iterator[Child]:
    one = Child()
    try:
        yield one
    finally:
        for process in (*psutil.Process(one.pid).children(recursive=True), one.popen):
            process.kill()
        one.popen.communicate()


def test_cpu_time_is_what_the_process_reads_itself() -> None:
    with child() as one:
        own = float(one.ask("burn(0.2)"))
        reading = cpu_s(one.pid)
        assert reading is not None
        assert reading[0] == pytest.approx(own, abs=0.03)
        assert reading[0] >= 0.2 - 0.03


def test_the_meter_counts_between_begin_and_end_by_name() -> None:
    with child() as one:
        one.ask("burn(0.2)")
        meter = Meter(one.pid, "supervisor")
        meter.begin()
        one.ask("burn(0.1)")
        inner = int(one.ask("start()"))
        meter.name(inner, "tracker")
        meter.sample()
        one.ask("finish()")  # a process that has ended keeps what it used
        meter.end()
        usage = meter.usage
        assert usage.cpu_s["supervisor"] == pytest.approx(0.1, abs=0.05)
        assert usage.cpu_s["tracker"] == pytest.approx(0.3, abs=0.1)
        assert set(usage.peak_pss_mb) == {"supervisor", "tracker"}
        assert usage.peak_total_pss_mb is not None
        assert usage.peak_total_pss_mb <= sum(usage.peak_pss_mb.values()) + 1e-6


def test_what_a_named_process_started_counts_as_it_even_when_it_has_ended() -> None:
    with child() as root:
        root_meter = Meter(psutil.Process().pid, "supervisor")  # the test process is the root here
        root_meter.name(root.pid, "backend")
        root_meter.begin()
        root.ask("start()")
        root_meter.sample()
        root.ask("finish()")
        root_meter.end()
        assert 0.2 < root_meter.usage.cpu_s["backend"] < 0.5


def test_pss_grows_with_what_is_touched() -> None:
    with child() as one:
        before = pss_mb(one.pid)
        one.ask("len(globals().setdefault('block', bytearray(b'1' * (50 << 20))))")
        after = pss_mb(one.pid)
        assert before is not None
        assert after is not None
        assert after - before == pytest.approx(50, abs=5)


def test_foreign_work_is_told_from_ours(monkeypatch: pytest.MonkeyPatch) -> None:
    readings = iter([(10.0, 100.0), (22.0, 120.0)])
    monkeypatch.setattr(resources, "machine_cpu", lambda: next(readings))
    with child() as one:
        meter = Meter(one.pid, "supervisor")
        meter.begin()
        meter.end()
        # 12 s busy of 20 s, next to nothing of it ours
        assert meter.usage.foreign_cpu == pytest.approx(0.6, abs=0.02)


def test_the_machine_has_more_time_than_it_was_busy() -> None:
    reading = machine_cpu()
    assert reading is not None
    assert 0.0 < reading[0] <= reading[1]


def test_readings_of_nobody_are_none(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(resources, "PROC", tmp_path)
    (tmp_path / "7").mkdir()
    (tmp_path / "7" / "stat").write_text("7 (odd) name) S 1")
    (tmp_path / "7" / "smaps_rollup").write_text("Pss: many kB")
    (tmp_path / "stat").write_text("cpu 1 2 three")
    assert (cpu_s(7), cpu_s(8), pss_mb(7), pss_mb(8), machine_cpu()) == (None,) * 5
    meter = Meter(2**30, "supervisor")
    meter.begin()
    meter.end()
    assert meter.usage.foreign_cpu is None
    assert meter.usage.peak_total_pss_mb is None


def test_what_others_took_is_of_the_machine_s_time_and_never_below_nothing() -> None:
    assert taken_by_others((10.0, 100.0), (16.0, 120.0), 2.0) == pytest.approx(0.2)
    assert taken_by_others((10.0, 100.0), (11.0, 120.0), 2.0) == 0.0
    assert taken_by_others((10.0, 100.0), (10.0, 100.0), 0.0) is None, "no time has passed"
    assert taken_by_others(None, (16.0, 120.0), 2.0) is None
    assert taken_by_others((10.0, 100.0), None, 2.0) is None
