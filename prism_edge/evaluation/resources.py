"""What a run costs: CPU time and memory of the daemon's processes, and what others took meanwhile.

Reads /proc (Linux); elsewhere, and where a reading fails, results are None.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import psutil

PROC = Path("/proc")
# Others' share of the machine above which timings say nothing about the daemon.
VOID_ABOVE = 0.1
_TICK_S = 1.0 / os.sysconf("SC_CLK_TCK")


@dataclass(frozen=True)
class Usage:
    """Between the first frame and the end; dictionaries are by process name."""

    cpu_s: dict[str, float]
    peak_pss_mb: dict[str, float]
    peak_total_pss_mb: float | None
    foreign_cpu: float | None


class Meter:
    """Watches the tree of processes below ``root``; call :meth:`sample` about once a second.

    A process is what has been announced by :meth:`name`; what it started counts as it, and what nobody
    announced counts as the root, called ``root_name``.
    """

    def __init__(self, root: int, root_name: str) -> None:
        self._root, self._names = root, {root: root_name}
        self._cpu: dict[tuple[str, int], float] = {}  # seconds each process had used when last seen
        self._cpu_before: dict[tuple[str, int], float] = {}
        self._pss: dict[str, float] = {}
        self._total_pss: float | None = None
        self._machine_before: tuple[float, float] | None = None
        self._ours_before = 0.0
        self._usage: Usage | None = None

    def name(self, pid: int, name: str) -> None:
        """Process ``pid`` is called ``name``; the root keeps its name."""
        if pid != self._root:
            self._names[pid] = name

    def begin(self) -> None:
        """The first frame is about to come: CPU time counts from here."""
        self._sample_cpu()
        self._cpu_before = dict(self._cpu)
        self._machine_before, self._ours_before = machine_cpu(), _own_cpu()

    def sample(self) -> None:
        """Looks at CPU time, so that a process that dies is not forgotten, and at memory."""
        owners = self._sample_cpu()
        pss: dict[str, float] = {}
        for pid, owner in owners.items():
            size = pss_mb(pid)
            if size is not None:
                pss[self._names[owner]] = pss.get(self._names[owner], 0.0) + size
        for name, size in pss.items():
            self._pss[name] = max(size, self._pss.get(name, 0.0))
        if pss:
            self._total_pss = max(sum(pss.values()), self._total_pss or 0.0)

    def end(self) -> None:
        """The last frame is done: what comes later does not count."""
        self.sample()
        used: dict[str, float] = {}
        for key, seconds in self._cpu.items():
            used[key[0]] = used.get(key[0], 0.0) + seconds - self._cpu_before.get(key, 0.0)
        now, ours = machine_cpu(), sum(used.values()) + _own_cpu() - self._ours_before
        foreign = taken_by_others(self._machine_before, now, ours)
        self._usage = Usage(used, dict(self._pss), self._total_pss, foreign)

    @property
    def usage(self) -> Usage:
        """What :meth:`end` found; nothing where it was never called."""
        return self._usage or Usage({}, dict(self._pss), self._total_pss, None)

    def _sample_cpu(self) -> dict[int, int]:
        """Updates CPU times; returns the announced process that each living one counts as."""
        owners = self._owners()
        seconds: dict[int, float] = {}
        for pid, owner in owners.items():
            own = cpu_s(pid)
            if own is not None:
                # Children a process has waited for are its own; the root's are workers counted already.
                reaped = own[1] if pid != self._root else 0.0
                seconds[owner] = seconds.get(owner, 0.0) + own[0] + reaped
        self._cpu.update({(self._names[owner], owner): value for owner, value in seconds.items()})
        return owners

    def _owners(self) -> dict[int, int]:
        try:
            tree = psutil.Process(self._root).children(recursive=True)
            parents = {child.pid: child.ppid() for child in tree}
        except psutil.Error:
            return {}
        owners = {self._root: self._root}
        for pid in parents:
            owner = pid
            while owner not in self._names and owner in parents:
                owner = parents[owner]
            owners[pid] = owner if owner in self._names else self._root
        return owners


def cpu_s(pid: int) -> tuple[float, float] | None:
    """User and system CPU seconds of all threads of a process, and of its children that have ended."""
    try:
        # The name in brackets may hold blanks and brackets itself; the numbers follow the last one.
        fields = (PROC / str(pid) / "stat").read_text().rpartition(")")[2].split()
        own, reaped = int(fields[11]) + int(fields[12]), int(fields[13]) + int(fields[14])
    except (OSError, IndexError, ValueError):
        return None
    return own * _TICK_S, reaped * _TICK_S


def pss_mb(pid: int, part: str = "") -> float | None:
    """Proportional set size (MB = 2^20 bytes): a page shared by n processes counts 1/n in each.

    ``part``: ``_Anon`` for memory that is no file's, ``_File`` for files' pages.
    """
    try:
        for line in (PROC / str(pid) / "smaps_rollup").read_text().splitlines():
            if line.startswith(f"Pss{part}:"):
                return int(line.split()[1]) / 1024.0
    except (OSError, IndexError, ValueError):
        pass
    return None


def machine_cpu() -> tuple[float, float] | None:
    """CPU seconds that the whole machine was busy and that it had, since it started, all cores together."""
    try:
        with (PROC / "stat").open() as file:
            user, nice, system, idle, wait, irq, softirq, steal = map(int, file.readline().split()[1:9])
    except (OSError, ValueError):
        return None
    busy = user + nice + system + irq + softirq + steal
    return busy * _TICK_S, (busy + idle + wait) * _TICK_S


def taken_by_others(
    before: tuple[float, float] | None, after: tuple[float, float] | None, ours_s: float
) -> float | None:
    """Share of the machine between two answers of :func:`machine_cpu` that was not our CPU seconds."""
    if before is None or after is None or after[1] <= before[1]:
        return None
    return max(0.0, after[0] - before[0] - ours_s) / (after[1] - before[1])


def _own_cpu() -> float:
    times = os.times()
    return times.user + times.system
