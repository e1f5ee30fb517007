"""Installing, upgrading, failing and removing, into a folder of its own with a python that only pretends."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

CHECKOUT = Path(__file__).resolve().parents[2]
PYTHON = Path(__file__).with_name("fake_python.sh")
UNITS = ("prism-edge.service", "prism-edge@.service")


def script(
    name: str, root: Path, *options: str, fail: str = "", checkout: Path = CHECKOUT, umask: int = 0o022
) -> subprocess.CompletedProcess[str]:
    command = [str(checkout / "deploy" / name), "--destdir", str(root), *options]
    environment = {**os.environ, "FAIL": fail, "REAL_PYTHON": sys.executable}
    return subprocess.run(
        command, capture_output=True, text=True, env=environment, timeout=60, umask=umask
    )


def install(root: Path, *options: str, **given: Any) -> subprocess.CompletedProcess[str]:
    return script("install.sh", root, "--python", str(PYTHON), *options, **given)


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
    assert (installed / "srv/prism-edge/models").is_dir()
    assert os.readlink(installed / "usr/local/bin/prism-edge") == "/opt/prism-edge/current/bin/prism-edge"


@pytest.mark.parametrize("relative", [False, True])
def test_the_command_of_an_image_names_its_python_in_the_image(
    relative: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    done = install(Path("an image") if relative else tmp_path / "an image")
    assert done.returncode == 0, done.stderr
    program = tmp_path / "an image/opt/prism-edge"
    command = program / "current/bin/prism-edge"
    release = os.readlink(program / "current")
    assert command.read_text() == f"#!/opt/prism-edge/{release}/bin/python\nimport prism_edge\n"
    assert os.access(command, os.X_OK)


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


@pytest.mark.parametrize("fail", ["pip", "package", "config"])
def test_a_failed_upgrade_leaves_all_as_it_was(installed: Path, fail: str) -> None:
    unit = installed / "etc/systemd/system" / UNITS[0]
    unit.write_text("the old unit\n")
    (installed / "etc/prism-edge/config.yaml.example").write_text("the old release's\n")
    before = tree(installed)
    done = install(installed, fail=fail)
    assert done.returncode != 0
    assert "putting back" in done.stderr
    assert tree(installed) == before
    assert (installed / "opt/prism-edge/current/bin/python").exists()


def test_a_failed_upgrade_is_undone_though_nobody_hears_of_it(installed: Path) -> None:
    """The terminal has gone (ssh over a robot's WiFi), or the log's disk is full."""
    (installed / "etc/systemd/system" / UNITS[0]).write_text("the old unit\n")
    before = tree(installed)
    command = [CHECKOUT / "deploy/install.sh", "--destdir", installed, "--python", PYTHON]
    environment = {**os.environ, "FAIL": "config", "REAL_PYTHON": sys.executable}
    with open("/dev/full", "w") as full:
        done = subprocess.run(command, stdout=subprocess.PIPE, stderr=full, env=environment, timeout=60)
    assert done.returncode != 0
    assert tree(installed) == before


def test_a_link_to_a_configuration_that_is_not_there_now_stays(installed: Path) -> None:
    settings = installed / "etc/prism-edge/config.yaml"
    settings.unlink()
    settings.symlink_to("/data/not-mounted/config.yaml")
    done = install(installed)
    assert done.returncode == 0, done.stderr
    assert "leads nowhere just now" in done.stderr
    assert os.readlink(settings) == "/data/not-mounted/config.yaml"


@pytest.fixture
def prefix() -> Iterator[Path]:
    """A folder of this machine that the service may see: pytest's own lie in /tmp."""
    with tempfile.TemporaryDirectory(prefix="prism-edge-", dir="/opt") as folder:
        yield Path(folder)


@pytest.mark.skipif(os.geteuid() != 0, reason="only root may install beside a running service")
def test_a_service_that_an_upgrade_has_not_touched_goes_on_running(tmp_path: Path, prefix: Path) -> None:
    """It fails before anything is put in place, so nothing of this machine is written either."""
    calls, tools = tmp_path / "calls", tmp_path / "bin"
    tools.mkdir()
    said = '[ "$1" != list-units ] || echo prism-edge.service loaded active'
    (tools / "systemctl").write_text(f'#!/bin/sh\necho "$*" >> "$CALLS"\n{said}\n')
    (tools / "systemctl").chmod(0o755)
    path = f"{tools}:{os.environ['PATH']}"
    command = [CHECKOUT / "deploy/install.sh", "--prefix", prefix, "--python", PYTHON]
    environment = {**os.environ, "FAIL": "pip", "PATH": path, "CALLS": str(calls)}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=60)
    assert done.returncode != 0
    assert {line.split()[0] for line in calls.read_text().splitlines()} == {"list-units"}
    assert not any((prefix / "releases").iterdir())


@pytest.mark.parametrize("fail", ["pip", "package", "config"])
def test_a_failed_first_installation_leaves_nothing(tmp_path: Path, fail: str) -> None:
    assert install(tmp_path, fail=fail).returncode != 0
    assert set(tree(tmp_path)) == {"opt/prism-edge/.lock"}


@pytest.mark.parametrize(
    "fail", ["home/ann/bin/python3", "root/.local/python3.12", "run/user/0/python", "tmp/python"]
)
def test_a_python_that_the_service_can_not_see_is_refused(tmp_path: Path, fail: str) -> None:
    done = install(tmp_path, fail=fail)
    assert done.returncode == 1
    assert f"{Path('/', fail).resolve()}; name another Python with --python" in done.stderr
    assert set(tree(tmp_path)) == {"opt/prism-edge/.lock"}


def test_another_prefix_reaches_the_units(tmp_path: Path) -> None:
    done = install(tmp_path, "--prefix", "/srv/pose")
    assert done.returncode == 0, done.stderr
    unit = (tmp_path / "etc/systemd/system" / UNITS[0]).read_text()
    assert "ExecStart=/srv/pose/current/bin/python" in unit
    assert "/opt/prism-edge" not in unit


@pytest.mark.parametrize("umask", [0o027, 0o077])
@pytest.mark.parametrize("earlier", [False, True], ids=["at first", "as an upgrade"])
def test_a_careful_root_installs_what_the_service_can_read(umask: int, earlier: bool, tmp_path: Path) -> None:
    """Its user belongs to nobody's group: everything must be open to others."""
    if earlier:  # as installers before this one left it
        for folder in ("opt/prism-edge/releases", "etc/prism-edge"):
            (tmp_path / folder).mkdir(parents=True)
            (tmp_path / folder).chmod(0o750)
    done = install(tmp_path, umask=umask)
    assert done.returncode == 0, done.stderr
    modes = {path: path.stat().st_mode for path in tmp_path.rglob("*") if path.exists()}
    assert modes
    assert [path for path, mode in modes.items() if not mode & 0o004] == []
    assert [path for path, mode in modes.items() if path.is_dir() and not mode & 0o001] == []


def test_a_checkout_stays_as_it_is_and_nothing_stale_is_taken_along(tmp_path: Path) -> None:
    checkout, root = tmp_path / "checkout", tmp_path / "root"
    skip = shutil.ignore_patterns("__pycache__")
    for name in ("deploy", "models", "prism_edge", "systemd", "tools"):
        shutil.copytree(CHECKOUT / name, checkout / name, ignore=skip)
    for name in ("LICENSE", "README.md", "pyproject.toml", "setup.py"):
        shutil.copy(CHECKOUT / name, checkout)
    stale = ("build/lib/gone.py", "prism_edge.egg-info/SOURCES.txt", "prism_edge/__pycache__/a.pyc")
    for name in stale:
        (checkout / name).parent.mkdir(parents=True, exist_ok=True)
        (checkout / name).write_text("stale")
    before = sorted(checkout.rglob("*"))
    done = install(root, "--extra", "oak", checkout=checkout)
    assert done.returncode == 0, done.stderr
    assert sorted(checkout.rglob("*")) == before
    given = (root / "opt/prism-edge/current/bin/sources").read_text().splitlines()
    assert {"./setup.py", "./prism_edge/__init__.py", "./models/registry.yaml"} <= set(given)
    assert [name for name in given if name.removeprefix("./") in stale] == []


def test_optional_dependencies_are_held_to_their_versions_too(tmp_path: Path) -> None:
    done = install(tmp_path, "--extra", "oak", "--extra", "metrics")
    assert done.returncode == 0, done.stderr
    asked = (tmp_path / "opt/prism-edge/current/bin/asked").read_text().splitlines()
    held = {Path(value).name for option, value in pairwise(asked) if option == "--constraint"}
    assert held == {"requirements.lock", "requirements-extras.lock"}
    assert asked[-1].endswith("[oak,metrics]")


@pytest.mark.parametrize("extras", [("stream",), ("oak", "Metrics"), ("oak,strems",), ("oak,",)])
def test_an_extra_that_is_none_is_refused_before_anything_is_made(
    extras: tuple[str, ...], tmp_path: Path
) -> None:
    done = install(tmp_path, *(word for name in extras for word in ("--extra", name)))
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "is none of ['dev', 'metrics', 'oak', 'streams']" in done.stderr
    assert not tree(tmp_path)


@pytest.mark.parametrize("prefix", ["relative", "/", "/a b", "/a&b", "/a#b"])
@pytest.mark.parametrize("name", ["install.sh", "uninstall.sh"])
def test_a_prefix_that_can_not_be_is_refused(name: str, prefix: str, tmp_path: Path) -> None:
    done = script(name, tmp_path, "--prefix", prefix)
    assert done.returncode == 2
    assert "--prefix must be" in done.stderr
    assert not tree(tmp_path)


@pytest.mark.parametrize(
    "prefix", ["/home/ann", "/root/pose", "/run/user/0/pose", "/tmp/pose", "/var/tmp", "/opt/../home/ann"]
)
def test_a_prefix_that_the_service_can_not_see_is_refused(prefix: str, tmp_path: Path) -> None:
    """By its place on the machine that it is for: the image itself may lie anywhere."""
    done = install(tmp_path, "--prefix", prefix)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert f"could not see {prefix}; take another --prefix" in done.stderr
    assert not tree(tmp_path)


@pytest.mark.skipif(not Path("/var/run").is_symlink(), reason="no link here that leads to /run")
def test_a_prefix_that_leads_where_the_service_can_not_see_is_refused() -> None:
    command = [CHECKOUT / "deploy/install.sh", "--prefix", "/var/run/user/0/pose", "--python", "false"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 2
    assert "could not see /var/run/user/0/pose" in done.stderr


def test_removal_keeps_configuration_and_maps_unless_told(installed: Path) -> None:
    maps = installed / "var/lib/private/prism-edge/maps"
    maps.mkdir(parents=True)
    (maps / "lab.map").write_text("a map")
    units = ("prism-edge", "prism-edge@", "prism-edge@front", "another")
    edits = [f"etc/systemd/system/{unit}.service.d/override.conf" for unit in units]
    for edit in edits:  # as `systemctl edit` makes them
        (installed / edit).parent.mkdir()
        (installed / edit).write_text("[Service]\n")
    for _ in range(2):  # twice is no error
        done = script("uninstall.sh", installed)
        assert done.returncode == 0, done.stderr
    kept = {"etc/prism-edge/config.yaml", "var/lib/private/prism-edge/maps/lab.map", *edits}
    assert set(tree(installed)) == kept
    assert not (installed / "srv/prism-edge").exists()
    assert script("uninstall.sh", installed, "--purge").returncode == 0
    assert list(tree(installed)) == edits[-1:]
    assert [folder.name for folder in (installed / "etc/systemd/system").iterdir()] == ["another.service.d"]


def test_removal_leaves_the_operators_networks(installed: Path) -> None:
    network = installed / "srv/prism-edge/models/net.onnx"
    network.write_text("a network")
    assert script("uninstall.sh", installed, "--purge").returncode == 0
    assert list(tree(installed)) == ["srv/prism-edge/models/net.onnx"]


@pytest.mark.parametrize("name", ["install.sh", "uninstall.sh", "make_certificates.sh"])
def test_whoever_asks_is_told_and_nothing_is_done(name: str) -> None:
    told = subprocess.run(
        [str(CHECKOUT / "deploy" / name), "--help"], check=False, timeout=60, capture_output=True, text=True
    )
    assert (told.returncode, told.stderr) == (0, "")
    assert f"usage: deploy/{name}" in told.stdout


def test_an_upgrade_keeps_optional_dependencies(tmp_path: Path) -> None:
    current = tmp_path / "opt/prism-edge/current/bin/asked"
    assert install(tmp_path, "--extra", "oak").returncode == 0
    assert install(tmp_path).returncode == 0
    assert current.read_text().splitlines()[-1].endswith("[oak]")
    assert install(tmp_path, "--extra", "metrics", "--extra", "oak").returncode == 0
    assert current.read_text().splitlines()[-1].endswith("[metrics,oak]")
