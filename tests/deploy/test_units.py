"""The unit files: what systemd's own tools say of them, and that the two agree."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest

from prism_edge.errors import ConfigError, ModelError
from prism_edge.supervisor.supervise import DESCRIPTORS

CHECKOUT = Path(__file__).resolve().parents[2]
UNIT, TEMPLATE = (CHECKOUT / "systemd" / name for name in ("prism-edge.service", "prism-edge@.service"))
MOST_EXPOSED = 2.0

needs_systemd = pytest.mark.skipif(not shutil.which("systemd-analyze"), reason="no systemd-analyze here")


def analyze(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(["systemd-analyze", *arguments], capture_output=True, text=True, timeout=60)


@pytest.fixture
def runnable(tmp_path: Path) -> dict[Path, Path]:
    """Copies whose program exists on this machine, which `verify` looks for."""
    copies = {}
    for unit, name in ((UNIT, UNIT.name), (TEMPLATE, "prism-edge@front.service")):
        program = shutil.which("true")
        text = re.sub(r"^ExecStart=\S+", f"ExecStart={program}", unit.read_text(), flags=re.MULTILINE)
        copies[unit] = tmp_path / name
        copies[unit].write_text(text)
    return copies


@needs_systemd
@pytest.mark.parametrize("unit", [UNIT, TEMPLATE], ids=lambda unit: unit.name)
def test_verify_has_nothing_to_say(unit: Path, runnable: dict[Path, Path]) -> None:
    done = analyze("verify", str(runnable[unit]))
    said = [line for line in done.stderr.splitlines() if "prism-edge" in line]
    assert done.returncode == 0, done.stderr
    assert said == []


@needs_systemd
@pytest.mark.parametrize("unit", [UNIT, TEMPLATE], ids=lambda unit: unit.name)
def test_exposure_is_low(unit: Path, runnable: dict[Path, Path]) -> None:
    done = analyze("security", "--offline=true", str(runnable[unit]))
    level = re.search(r"Overall exposure level .*: ([0-9.]+)", done.stdout)
    assert level, done.stderr
    assert float(level[1]) <= MOST_EXPOSED


def test_the_template_differs_by_its_instance_alone() -> None:
    def meant(path: Path) -> list[str]:
        text = path.read_text().replace("-%i", "").replace("%i.yaml", "config.yaml").replace(" (%i)", "")
        return [line for line in text.splitlines() if not line.startswith("#")]

    assert meant(TEMPLATE) == meant(UNIT)


def test_what_lies_in_the_state_directory_is_no_program() -> None:
    assert re.search(r"^ExecStart=\S+/python -P -m prism_edge\.cli ", UNIT.read_text(), re.MULTILINE)


def test_the_clock_is_set_before_stamps_are_taken_from_it() -> None:
    after = re.search(r"^After=(.*)$", UNIT.read_text(), re.MULTILINE)
    assert after
    assert "time-sync.target" in after[1].split()


def test_what_a_restart_can_not_mend_is_not_restarted() -> None:
    codes = re.search(r"^RestartPreventExitStatus=(.*)$", UNIT.read_text(), re.MULTILINE)
    assert codes
    assert {int(code) for code in codes[1].split()} == {2, ConfigError.exit_code, ModelError.exit_code}


@pytest.mark.parametrize("unit", [UNIT, TEMPLATE], ids=lambda unit: unit.name)
def test_a_state_directory_in_memory_outlives_a_restart(unit: Path) -> None:
    assert re.search(r"^RuntimeDirectory=prism-edge", unit.read_text(), re.MULTILINE)
    assert re.search(r"^RuntimeDirectoryPreserve=restart$", unit.read_text(), re.MULTILINE)


@pytest.mark.parametrize("unit", [UNIT, TEMPLATE], ids=lambda unit: unit.name)
def test_connections_that_say_nothing_leave_descriptors(unit: Path) -> None:
    limit = re.search(r"^LimitNOFILE=(\d+)$", unit.read_text(), re.MULTILINE)
    assert limit
    assert int(limit[1]) == DESCRIPTORS
