"""What a peak took is given back."""

from __future__ import annotations

import ctypes
import subprocess
import sys
import threading
from collections.abc import Iterator
from types import SimpleNamespace

import pytest

from prism_edge.workers import heap

# Blocks below the threshold that glibc would have arrived at by itself, freed with something small behind.
PEAK = """
import sys
import numpy as np
from prism_edge.workers.heap import bound_heap
if sys.argv[1] == "bound" and not bound_heap():
    raise SystemExit(3)
def resident():
    with open("/proc/self/smaps_rollup") as file:
        return next(int(line.split()[1]) for line in file if line.startswith("Pss_Anon"))
del (first := [np.ones(2 << 20, np.uint8) for _ in range(3)])[:]
before = resident()
blocks = [np.ones(24 << 20, np.uint8)]
del blocks
kept = []
blocks = []
for _ in range(20):
    blocks.append(np.ones(9 << 20, np.uint8))
    kept.append(bytes(2000))
del blocks
print(resident() - before)
"""


def growth_kb(how: str) -> int:
    done = subprocess.run([sys.executable, "-c", PEAK, how], capture_output=True, text=True)
    if done.returncode == 3:
        pytest.skip("not glibc")
    assert not done.stderr
    return int(done.stdout)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="mallopt is glibc's")
def test_a_peak_is_given_back() -> None:
    assert growth_kb("unbound") > 10_000, "else there is nothing to bound here"
    assert growth_kb("bound") < 5000


IMAGES = """
import resource, sys
import numpy as np
from prism_edge.workers.heap import bound_heap
if not bound_heap():
    raise SystemExit(3)
height, width = map(int, sys.argv[1:])
def work():
    colour = np.ones((height, width, 3), np.uint8)
    other = colour.copy()
    copied = other.tobytes()
    grey = other.max(axis=2)
for _ in range(3):
    work()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(20):
    work()
print((resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before) / 20)
"""


@pytest.mark.parametrize("size", [(480, 640), (720, 1280), (1080, 1920)])
def test_an_images_pages_are_not_mapped_anew_each_time(size: tuple[int, int]) -> None:
    done = subprocess.run([sys.executable, "-c", IMAGES, *map(str, size)], capture_output=True, text=True)
    if done.returncode == 3:
        pytest.skip("not glibc")
    assert not done.stderr
    pages = 3 * size[0] * size[1] // 4096
    assert float(done.stdout) < 0.2 * pages


HOLES = """
import threading, time
from prism_edge.workers.heap import keep_trimmed
def resident():
    with open("/proc/self/smaps_rollup") as file:
        return next(int(line.split()[1]) for line in file if line.startswith("Pss_Anon"))
before = resident()
blocks = [bytes(3000) for _ in range(40_000)]
blocks = [block for i, block in enumerate(blocks) if i % 50 == 0]
print(resident() - before > 50_000)
keep_trimmed(threading.Event(), 0.05)
deadline = time.monotonic() + 20.0
while resident() - before > 30_000 and time.monotonic() < deadline:
    time.sleep(0.05)
print(resident() - before < 30_000)
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="malloc_trim is glibc's")
def test_holes_in_the_midst_of_the_heap_are_given_back() -> None:
    done = subprocess.run([sys.executable, "-c", HOLES], capture_output=True, text=True)
    assert not done.stderr
    assert done.stdout.split() == ["True", "True"]


MB = 1 << 20


def trims(monkeypatch: pytest.MonkeyPatch, sizes: list[int]) -> list[int]:
    """How large (MB) a process was when it gave back, of ``sizes`` look by look."""
    stopped, seen, at = threading.Event(), [0], list[int]()
    looks: Iterator[int] = iter(sizes)

    def resident() -> int:
        size = next(looks, None)
        if size is None:
            stopped.set()
            return seen[-1]
        seen.append(size * MB)
        return seen[-1]

    library = SimpleNamespace(malloc_trim=lambda pad: at.append(seen[-1] // MB))
    monkeypatch.setattr(ctypes, "CDLL", lambda name: library)
    monkeypatch.setattr(heap, "_resident", resident)
    heap.keep_trimmed(stopped, 0.001)
    for thread in threading.enumerate():
        if thread.name == "heap":
            thread.join(20.0)
    assert stopped.is_set()
    return at


def test_what_stays_as_large_is_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    assert trims(monkeypatch, [100, 104, 107, 101, 108, 90, 107]) == [], "its huge pages stay whole"


def test_what_grows_gives_back(monkeypatch: pytest.MonkeyPatch) -> None:
    assert trims(monkeypatch, [100, 104, 109, 102, 105, 110, 111, 120, 118, 130]) == [109, 111, 130]


def test_what_work_takes_again_is_not_given_back_each_time(monkeypatch: pytest.MonkeyPatch) -> None:
    assert trims(monkeypatch, [100, 120, 119, 120, 119, 121, 126]) == [120]


def test_what_a_peak_left_is_given_back_after_all(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its holes count as usual where the first look finds it."""
    assert trims(monkeypatch, [300] * heap.SELDOM + [80] * 5) == [300]


def test_a_process_knows_its_size() -> None:
    before = heap._resident()
    block = bytearray(b"x" * (40 * MB))
    assert heap._resident() - before > 30 * MB
    del block
