"""What an installation rests on: the lock, the versions, the commands."""

from __future__ import annotations

import importlib
import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import cv2
import numpy as np
import pytest

from prism_edge import __version__

CHECKOUT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((CHECKOUT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
LOCK, EXTRAS = (
    (CHECKOUT / name).read_text(encoding="utf-8").splitlines()
    for name in ("requirements.lock", "requirements-extras.lock")
)
OPTIONAL = PROJECT["optional-dependencies"]


def normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def name_of(wanted: str) -> str:
    found = re.match(r"[A-Za-z0-9._-]+", wanted)
    assert found is not None
    return normal(found.group())


@pytest.mark.parametrize("lock", [LOCK, EXTRAS], ids=["lock", "extras"])
def test_lock_holds_exact_versions_and_names_no_host(lock: list[str]) -> None:
    lines = [line for line in lock if not line.startswith("#")]
    assert lines
    pinned = r'[a-z0-9-]+==[0-9][0-9a-z.]*( ; python_version < "3\.\d+")?'
    assert all(re.fullmatch(pinned, line) for line in lines)


def test_what_a_newer_python_has_built_in_is_not_asked_for_there() -> None:
    (line,) = (line for line in LOCK if line.startswith("backports-zstd"))
    assert line.endswith(' ; python_version < "3.14"'), "it can't be installed there"


@pytest.mark.parametrize("wanted", PROJECT["dependencies"] + OPTIONAL["dev"])
def test_lock_covers_every_dependency(wanted: str) -> None:
    assert any(line.startswith(f"{name_of(wanted)}==") for line in LOCK), "run `make lock`"


@pytest.mark.parametrize("wanted", sorted({item for extra in OPTIONAL.values() for item in extra}))
def test_what_is_optional_is_locked_once(wanted: str) -> None:
    found = [line for line in LOCK + EXTRAS if line.startswith(f"{name_of(wanted)}==")]
    assert len(found) == 1, "run `make lock`"


def test_version_is_said_once() -> None:
    assert PROJECT["version"] == __version__


def test_installed_command_exists() -> None:
    module, _, function = PROJECT["scripts"]["prism-edge"].partition(":")
    assert callable(getattr(importlib.import_module(module), function))


def test_python_too_old_or_absent_is_said_in_one_line(tmp_path: Path) -> None:
    """A path with nothing but a shim behind which there is no Python."""
    (tmp_path / "python3.11").write_text("#!/bin/sh\necho 'no such version' >&2\nexit 127\n")
    (tmp_path / "python3.11").chmod(0o755)
    found = subprocess.run(
        ["/bin/bash", CHECKOUT / "tools" / "find_python.sh"],
        env={"PATH": str(tmp_path)},
        capture_output=True,
        text=True,
    )
    assert found.returncode == 1
    assert found.stdout == ""
    assert found.stderr.startswith("error: no Python >= 3.11 found")
    assert found.stderr.count("\n") == 1


@pytest.mark.parametrize("place", ["bin", "a folder with spaces"])
def test_python_that_is_named_is_taken(place: str, tmp_path: Path) -> None:
    python = tmp_path / place / "python3"
    python.parent.mkdir()
    python.write_text(f'#!/bin/sh\nexec "{sys.executable}" "$@"\n')
    python.chmod(0o755)
    (tmp_path / "venv.py").write_text("raise SystemExit('the folder is asked')\n")
    for given in ({"PATH": "/nowhere", "PYTHON": str(python)}, {"PATH": str(python.parent)}):
        found = subprocess.run(
            ["/bin/bash", CHECKOUT / "tools" / "find_python.sh"],
            env=given,
            cwd=tmp_path,
            capture_output=True,
            text=True,
        )
        assert found.stdout == f"{python}\n"


@pytest.mark.parametrize("named", ["/nowhere/python3", "no-such-python", "false"])
def test_no_other_python_takes_the_place_of_one_that_is_named(named: str, tmp_path: Path) -> None:
    for name, command in (("python3", f'exec "{sys.executable}" "$@"'), ("false", "exit 1")):
        (tmp_path / name).write_text(f"#!/bin/sh\n{command}\n")
        (tmp_path / name).chmod(0o755)
    found = subprocess.run(
        ["/bin/bash", CHECKOUT / "tools" / "find_python.sh"],
        env={"PATH": str(tmp_path), "PYTHON": named},
        capture_output=True,
        text=True,
    )
    assert found.returncode == 1
    assert found.stdout == ""
    assert found.stderr == f"error: PYTHON={named} is no Python >= 3.11\n"


def test_the_oldest_releases_are_tried_with_the_oldest_python(tmp_path: Path) -> None:
    """Of some there are no wheels for a newer one; find_python.sh prefers newer ones."""
    tools = tmp_path / "tools"
    tools.mkdir()
    for name in ("oldest.sh", "find_python.sh"):
        shutil.copy(CHECKOUT / "tools" / name, tools)
    for name in ("python3.13", "python3.11"):
        asked = f'case "$*" in "-m venv"*) echo {name}; exit 1 ;; esac'
        (tmp_path / name).write_text(f'#!/bin/sh\n{asked}\nexec "{sys.executable}" "$@"\n')
        (tmp_path / name).chmod(0o755)
    path = f"{tmp_path}:/usr/bin:/bin"
    made = subprocess.run(
        ["/bin/bash", tools / "oldest.sh"], env={"PATH": path}, capture_output=True, text=True
    )
    assert made.stdout == "python3.11\n"


def test_a_python_that_is_to_be_avoided_is_the_last_choice(tmp_path: Path) -> None:
    """By where it really lies: the installer's service sees no home, and shims point there."""
    home, other = tmp_path / "home", tmp_path / "other"
    for place in (home, other):
        place.mkdir()
        asked, run = f"*realpath*) echo {place}/real", f'*) exec "{sys.executable}" "$@"'
        (place / "python3").write_text(f'#!/bin/sh\ncase "$*" in {asked} ;; {run} ;; esac\n')
        (place / "python3").chmod(0o755)

    def found(*folders: Path, named: str = "") -> str:
        path = ":".join(map(str, folders))
        return subprocess.run(
            ["/bin/bash", CHECKOUT / "tools" / "find_python.sh"],
            env={"PATH": path, "PYTHON": named, "AVOID": f"/nowhere {home}"},
            capture_output=True,
            text=True,
            check=True,
        ).stdout.strip()

    assert found(home, other) == str(other / "python3")
    assert found(home) == str(home / "python3")
    assert found(other, named=str(home / "python3")) == str(home / "python3")


@pytest.mark.skipif(not shutil.which("make"), reason="no make here")
def test_an_environment_is_made_once_and_anew_where_it_was_moved(tmp_path: Path) -> None:
    """With a python that only pretends."""
    python, first, second = tmp_path / "python", tmp_path / "first", tmp_path / "the second"
    venv = '[[ "$*" != "-m venv "* ]] || { mkdir -p "${!#}/bin"; cp "$0" "${!#}/bin/python"; }'
    python.write_text(f"#!/bin/bash\n{venv}\n")
    python.chmod(0o755)
    (first / "tools").mkdir(parents=True)
    for name in ("Makefile", "requirements.lock", "pyproject.toml", "setup.py", "tools/find_python.sh"):
        shutil.copy(CHECKOUT / name, first / name)

    def setup(checkout: Path, venv: str | Path = ".venv") -> str:
        command = ["make", "setup", f"VENV={venv}"]
        environment = {**os.environ, "PYTHON": str(python), "MAKEFLAGS": ""}
        return subprocess.run(
            command, cwd=checkout, env=environment, capture_output=True, text=True, check=True, timeout=60
        ).stdout

    assert "making .venv with" in setup(first)
    assert "making" not in setup(first)
    first.rename(second)
    assert "making .venv with" in setup(second)
    assert "installing" not in setup(second)

    own = tmp_path / "own"
    (own / "bin").mkdir(parents=True)
    shutil.copy(python, own / "bin" / "python")
    for _ in range(2):
        said = setup(second, own)
        assert "installing" in said
        assert "making" not in said, "an environment that lies elsewhere is never cleared"
        (own / ".place").write_text("another checkout that uses it too\n")


@pytest.mark.skipif(not shutil.which("make"), reason="no make here")
@pytest.mark.parametrize("name", ["venv", "../own", "{elsewhere}/own"])
def test_clean_removes_no_environment_but_the_checkouts(name: str, tmp_path: Path) -> None:
    """Named in the shell's environment, as it may be for another project's sake."""
    checkout = tmp_path / "checkout"
    for folder in (checkout / "build", checkout / "venv", tmp_path / "own"):
        folder.mkdir(parents=True)
    shutil.copy(CHECKOUT / "Makefile", checkout / "Makefile")
    environment = {**os.environ, "VENV": name.format(elsewhere=tmp_path), "MAKEFLAGS": ""}
    subprocess.run(["make", "clean"], cwd=checkout, env=environment, check=True, timeout=60)
    assert not (checkout / "build").exists()
    assert (checkout / "venv").exists() is (name != "venv")
    assert (tmp_path / "own").exists()


def test_the_installed_package_plays_the_demo_from_an_empty_folder(tmp_path: Path) -> None:
    """Built without its tests, tools and checkout, it brings a network and a world, and needs no cache."""
    source, built, empty = tmp_path / "source", tmp_path / "built", tmp_path / "empty"
    skip = shutil.ignore_patterns("__pycache__")
    for name in ("prism_edge", "models"):
        shutil.copytree(CHECKOUT / name, source / name, ignore=skip)
    for name in ("setup.py", "pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(CHECKOUT / name, source / name)
    build = [sys.executable, "setup.py", "-q", "build", "--build-base", str(tmp_path / "work")]
    subprocess.run([*build, "--build-lib", str(built)], cwd=source, check=True, timeout=120)
    shutil.rmtree(source)
    empty.mkdir()
    environment = {
        **os.environ,
        "PYTHONPATH": str(built),
        "HOME": str(empty),
        "XDG_CACHE_HOME": str(empty / "cache"),
        "PRISM_EDGE_MODELS": "",
    }
    where = [sys.executable, "-c", "import prism_edge.depth as d; print(d.locate('prism_nano'))"]
    found = subprocess.run(where, cwd=empty, env=environment, capture_output=True, text=True, check=True)
    assert Path(found.stdout.strip()).is_relative_to(built)
    walk = "sim:room?seed=3&frames=45&width=320&height=240"
    demo = [sys.executable, "-m", "prism_edge.cli", "demo", walk, "--lockstep"]
    played = subprocess.run(demo, cwd=empty, env=environment, capture_output=True, text=True, timeout=120)
    assert played.returncode == 0, played.stderr
    out = empty / "prism-edge-demo"
    report = json.loads((out / "metrics.json").read_text())
    assert report["config"]["depth"]["model"] == "prism_nano"
    assert report["coverage"] > 0.85
    assert len(np.loadtxt(out / "live.tum")) == report["tracked"]
    assert f"{report['tracked']} of 45 frames" in played.stdout
    assert any(line.startswith("t ") and " m  sigma " in line for line in played.stdout.splitlines())
    assert cv2.imread(str(out / "path.png")).std() > 5  # something is drawn
