"""Large pages for who asks, and asking once."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from prism_edge import huge_pages
from prism_edge.cli.main import script
from prism_edge.huge_pages import KERNEL, TUNABLE, VARIABLE, begin_with_huge_pages, with_huge_pages

CHECKOUT = Path(__file__).resolve().parents[1]
Begun = list[tuple[list[str], dict[str, str]]]
ASKS = with_huge_pages({}) != {}  # whether this machine leaves the choice to programs


def kernel(folder: Path, enabled: str, size: int = 2 << 20) -> Path:
    (folder / "enabled").write_text(enabled + "\n")
    (folder / "hpage_pmd_size").write_text(f"{size}\n")
    return folder


@pytest.fixture
def glibc(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    monkeypatch.setattr(os, "confstr", lambda name: "glibc 2.36", raising=False)
    return monkeypatch


@pytest.mark.usefixtures("glibc")
def test_a_program_asks_where_the_kernel_leaves_it_the_choice(tmp_path: Path) -> None:
    leaves = kernel(tmp_path, "always [madvise] never")
    assert with_huge_pages({"A": "b"}, leaves) == {"A": "b", VARIABLE: f"{TUNABLE}=1"}
    other = {VARIABLE: "glibc.malloc.tcache_count=0"}
    assert with_huge_pages(other, leaves) == {VARIABLE: f"glibc.malloc.tcache_count=0:{TUNABLE}=1"}
    told = {VARIABLE: f"{TUNABLE}=0"}
    assert with_huge_pages(told, leaves) == told


@pytest.mark.usefixtures("glibc")
@pytest.mark.parametrize("enabled", ["[always] madvise never", "always madvise [never]", ""])
def test_where_all_or_none_have_them_nothing_is_asked(tmp_path: Path, enabled: str) -> None:
    assert with_huge_pages({}, kernel(tmp_path, enabled)) == {}


@pytest.mark.usefixtures("glibc")
def test_huge_ones_of_512_mb_would_take_more_than_they_give(tmp_path: Path) -> None:
    assert with_huge_pages({}, kernel(tmp_path, "always [madvise] never", 512 << 20)) == {}


@pytest.mark.usefixtures("glibc")
def test_a_system_that_knows_none_is_left_as_it_is(tmp_path: Path) -> None:
    assert with_huge_pages({}, tmp_path) == {}
    kernel(tmp_path, "always [madvise] never")
    (tmp_path / "hpage_pmd_size").write_text("many\n")
    assert with_huge_pages({}, tmp_path) == {}


@pytest.mark.parametrize("version", ["glibc 2.34", "musl 1.2.5", "glibc", "glibc x.y", "", None])
def test_another_c_library_is_left_as_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, version: str | None
) -> None:
    monkeypatch.setattr(os, "confstr", lambda name: version, raising=False)
    assert with_huge_pages({}, kernel(tmp_path, "always [madvise] never")) == {}


def test_a_system_without_such_a_name_is_left_as_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def confstr(name: str) -> str:
        raise ValueError("unrecognized configuration name")

    monkeypatch.setattr(os, "confstr", confstr, raising=False)
    assert with_huge_pages({}, kernel(tmp_path, "always [madvise] never")) == {}


AGAIN = """
import os, sys
from prism_edge.huge_pages import begin_with_huge_pages
print(os.getpid(), flush=True)
begin_with_huge_pages()
print(os.environ.get("GLIBC_TUNABLES"), *sys.argv[1:])
"""


@pytest.mark.skipif(not ASKS, reason="this kernel or C library leaves no choice of huge pages")
def test_the_same_process_begins_anew_once() -> None:
    environment = {k: v for k, v in os.environ.items() if k != VARIABLE}
    environment["PYTHONPATH"] = str(CHECKOUT)
    command = [sys.executable, "-c", AGAIN, "a word"]
    with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) as process:
        said, _ = process.communicate(timeout=60)
    assert said.splitlines() == [str(process.pid), str(process.pid), f"{TUNABLE}=1 a word"]


HEAP = """
import numpy as np
from prism_edge.workers.heap import bound_heap
bound_heap()
images = [np.ones(300_000, np.uint8) for _ in range(60)]
with open("/proc/self/smaps_rollup") as file:
    print(next(int(line.split()[1]) for line in file if line.startswith("AnonHugePages")))
"""


@pytest.mark.skipif(not ASKS, reason="this kernel or C library leaves no choice of huge pages")
def test_what_asks_has_them_behind_its_images() -> None:
    def huge_kb(environment: dict[str, str]) -> int:
        environment["PYTHONPATH"] = str(CHECKOUT)
        done = subprocess.run([sys.executable, "-c", HEAP], env=environment, capture_output=True, text=True)
        return int(done.stdout)

    plain = {k: v for k, v in os.environ.items() if k != VARIABLE}
    assert huge_kb(plain) == 0
    assert huge_kb(with_huge_pages(plain, KERNEL)) >= 8 << 10


@pytest.mark.parametrize(("command", "begins"), [("run", True), ("worker", True), ("config", False)])
def test_only_what_stays_begins_so(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], command: str, begins: bool
) -> None:
    begun: list[str] = []
    monkeypatch.setattr("prism_edge.cli.main.begin_with_huge_pages", lambda: begun.append(command))
    monkeypatch.setattr("prism_edge.cli.main.ended", lambda code: code)
    monkeypatch.setattr(sys, "argv", ["prism-edge", command, "--help"])
    with pytest.raises(SystemExit):
        script()
    assert begun == ([command] if begins else [])
    assert command in capsys.readouterr().out


@pytest.fixture
def begun(monkeypatch: pytest.MonkeyPatch) -> Begun:
    """Command lines and environments that were begun, of a `prism-edge run --stay` that may."""
    lines: Begun = []
    monkeypatch.setattr(huge_pages, "with_huge_pages", lambda given: {**given, VARIABLE: "x"})
    monkeypatch.setattr(os, "execve", lambda program, words, environment: lines.append((words, environment)))
    monkeypatch.setattr(sys, "argv", ["/bin/prism-edge", "run", "--stay"])
    monkeypatch.setattr(sys, "orig_argv", ["python", "-P", "/bin/prism-edge", "run", "--stay"])
    return lines


def test_it_is_the_interpreters_own_command_line(begun: Begun) -> None:
    begin_with_huge_pages()
    [(words, environment)] = begun
    assert words == [sys.executable, "-P", "/bin/prism-edge", "run", "--stay"]
    assert environment[VARIABLE] == "x"


@pytest.mark.parametrize(
    ("argv", "orig_argv"),
    [
        (["prism-edge", "run"], ["python", "robot.py"]),
        (["prism-edge", "run"], ["python", "robot.py", "start"]),
        (["-", "run"], ["python", "-", "run"]),
    ],
)
def test_a_program_that_would_not_come_here_again_goes_on(
    begun: Begun,
    monkeypatch: pytest.MonkeyPatch,
    argv: list[str],
    orig_argv: list[str],
) -> None:
    """Another program that calls us, and one that was read from stdin."""
    monkeypatch.setattr(sys, "argv", argv)
    monkeypatch.setattr(sys, "orig_argv", orig_argv)
    begin_with_huge_pages()
    assert begun == []


@pytest.mark.usefixtures("begun")
def test_one_that_may_not_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    def execve(*command: object) -> None:
        raise PermissionError("Operation not permitted")

    monkeypatch.setattr(os, "execve", execve)
    begin_with_huge_pages()


def test_a_debugger_keeps_its_breakpoints(
    begun: Begun, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "gettrace", lambda: print)
    begin_with_huge_pages()
    assert begun == []


def test_once_also_where_the_c_library_takes_the_variable_away(
    begun: Begun, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As from a python with capabilities of its own: `setcap cap_sys_nice+ep`."""
    begin_with_huge_pages()
    left = {name: value for name, value in begun[0][1].items() if name != VARIABLE}
    monkeypatch.setattr(os, "environ", left)
    begin_with_huge_pages()
    assert len(begun) == 1


def test_a_program_that_is_not_to_be_found_goes_on_as_it_is(
    begun: Begun, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "executable", "")
    begin_with_huge_pages()
    assert begun == []
