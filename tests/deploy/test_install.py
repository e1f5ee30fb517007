"""Installing, upgrading, failing and removing, into a folder of its own with a python that only pretends."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest

CHECKOUT = Path(__file__).resolve().parents[2]
PYTHON = Path(__file__).with_name("fake_python.sh")
UNITS = ("prism-edge.service", "prism-edge@.service")


def script(name: str, root: Path, *options: str, fail: str = "") -> subprocess.CompletedProcess[str]:
    command = [str(CHECKOUT / "deploy" / name), "--destdir", str(root), *options]
    environment = {**os.environ, "FAIL": fail}
    return subprocess.run(command, capture_output=True, text=True, env=environment, timeout=60)


def install(root: Path, *options: str, fail: str = "") -> subprocess.CompletedProcess[str]:
    return script("install.sh", root, "--python", str(PYTHON), *options, fail=fail)


def tree(root: Path) -> dict[str, str]:
    """Every file and link with what it holds, the names of releases aside."""
    found = {}
    for path in sorted(root.rglob("*")):
        if path.is_symlink():
            found[str(path.relative_to(root))] = os.readlink(path)
        elif path.is_file():
            found[str(path.relative_to(root))] = path.read_text()
    return found


@pytest.fixture
def installed(tmp_path: Path) -> Path:
    done = install(tmp_path)
    assert done.returncode == 0, done.stderr
    return tmp_path


def test_everything_is_in_its_place(installed: Path) -> None:
    assert (installed / "opt/prism-edge/current/bin/python").exists()
    for unit in UNITS:
        assert (installed / "etc/systemd/system" / unit).read_text() == (
            CHECKOUT / "systemd" / unit
        ).read_text()
    assert (installed / "etc/udev/rules.d/60-prism-edge-oak.rules").is_file()
    assert (installed / "etc/prism-edge/config.yaml").is_file()
    assert os.readlink(installed / "usr/local/bin/prism-edge") == "/opt/prism-edge/current/bin/prism-edge"


def test_an_upgrade_keeps_configuration_and_one_release_to_go_back_to(installed: Path) -> None:
    settings = installed / "etc/prism-edge/config.yaml"
    settings.write_text("robot: mine\n")
    maps = installed / "var/lib/prism-edge/maps"
    maps.mkdir(parents=True)
    (maps / "lab.map").write_text("a map")
    releases = []
    for _ in range(3):
        done = install(installed)
        assert done.returncode == 0, done.stderr
        releases.append(os.readlink(installed / "opt/prism-edge/current"))
    assert len(set(releases)) == 3
    kept = {path.name for path in (installed / "opt/prism-edge/releases").iterdir()}
    assert kept == {Path(release).name for release in releases[1:]}
    assert settings.read_text() == "robot: mine\n"
    assert (maps / "lab.map").read_text() == "a map"


@pytest.mark.parametrize("fail", ["pip", "config"])
def test_a_failed_upgrade_leaves_all_as_it_was(installed: Path, fail: str) -> None:
    unit = installed / "etc/systemd/system" / UNITS[0]
    unit.write_text("the old unit\n")
    before = tree(installed)
    done = install(installed, fail=fail)
    assert done.returncode != 0
    assert "putting back" in done.stderr
    assert tree(installed) == before
    assert (installed / "opt/prism-edge/current/bin/python").exists()


def test_a_failed_first_installation_leaves_no_program(tmp_path: Path) -> None:
    assert install(tmp_path, fail="pip").returncode != 0
    assert set(tree(tmp_path)) == {"opt/prism-edge/.lock"}


def test_another_prefix_reaches_the_units(tmp_path: Path) -> None:
    done = install(tmp_path, "--prefix", "/srv/pose")
    assert done.returncode == 0, done.stderr
    unit = (tmp_path / "etc/systemd/system" / UNITS[0]).read_text()
    assert "ExecStart=/srv/pose/current/bin/python" in unit
    assert "/opt/prism-edge" not in unit


@pytest.mark.parametrize("prefix", ["relative", "/", "/a b", "/a&b", "/a#b"])
@pytest.mark.parametrize("name", ["install.sh", "uninstall.sh"])
def test_a_prefix_that_can_not_be_is_refused(name: str, prefix: str, tmp_path: Path) -> None:
    done = script(name, tmp_path, "--prefix", prefix)
    assert done.returncode == 2
    assert "--prefix must be" in done.stderr
    assert not tree(tmp_path)


def test_removal_keeps_configuration_and_maps_unless_told(installed: Path) -> None:
    maps = installed / "var/lib/private/prism-edge/maps"
    maps.mkdir(parents=True)
    (maps / "lab.map").write_text("a map")
    for _ in range(2):  # twice is no error
        done = script("uninstall.sh", installed)
        assert done.returncode == 0, done.stderr
    assert set(tree(installed)) == {"etc/prism-edge/config.yaml", "var/lib/private/prism-edge/maps/lab.map"}
    assert script("uninstall.sh", installed, "--purge").returncode == 0
    assert tree(installed) == {}
