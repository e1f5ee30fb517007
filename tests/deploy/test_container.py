"""Image and compose file as they are written, and the configuration that they ship: no engine is needed."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml

from prism_edge.cli.main import main

CHECKOUT = Path(__file__).resolve().parents[2]
DOCKERFILE = (CHECKOUT / "deploy" / "Dockerfile").read_text(encoding="utf-8")


def copied() -> set[str]:
    """Names at the top of the checkout that the image is built from."""
    lines = re.findall(r"^COPY (?!--from)(.*)$", DOCKERFILE, re.MULTILINE)
    return {name for line in lines for name in line.split()[:-1]}


def test_the_image_is_built_from_what_the_installer_builds_from() -> None:
    installer = (CHECKOUT / "deploy" / "install.sh").read_text(encoding="utf-8")
    taken = re.search(r"--exclude=__pycache__ (.*?) \|", installer)
    assert taken
    assert {name for name in copied() if not name.endswith(".lock")} == set(taken[1].split())
    assert all((CHECKOUT / name).exists() for name in copied())


def test_leavings_of_a_checkout_stay_out_of_the_build() -> None:
    ignored = (CHECKOUT / ".dockerignore").read_text(encoding="utf-8").splitlines()
    assert {".git", ".venv*", "build", "runs", "*.egg-info", "**/__pycache__"} <= set(ignored)


def daemon() -> dict[str, Any]:
    compose = yaml.safe_load((CHECKOUT / "deploy" / "compose.yaml").read_text(encoding="utf-8"))
    service: dict[str, Any] = compose["services"]["prism-edge"]
    return service


def test_every_path_of_the_configuration_is_in_the_container() -> None:
    text = (CHECKOUT / "deploy" / "config.yaml").read_text(encoding="utf-8")
    mounted = [Path(volume.split(":")[1]) for volume in daemon()["volumes"] if volume.startswith("/")]
    named = re.findall(r"(?:camera|model): (/\S+)", text)
    assert len(named) == 2  # one of them in a comment
    assert all(any(Path(path).is_relative_to(folder) for folder in mounted) for path in named)


def test_folders_of_the_host_are_read_only() -> None:
    folders = [volume for volume in daemon()["volumes"] if volume[0] in "./"]
    assert folders
    assert all(volume.endswith(":ro") for volume in folders)


def test_the_shipped_configuration_lacks_nothing_but_a_camera_file(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["config", "--check", str(CHECKOUT / "deploy" / "config.yaml")]) == 0
    said = capsys.readouterr().err.splitlines()
    assert [line for line in said if "camera file /srv/prism-edge/camera.yaml" not in line] == []


def test_the_image_takes_every_optional_dependency() -> None:
    assert "EXTRAS" in daemon()["build"]["args"]
    project = tomllib.loads((CHECKOUT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    (said,) = re.findall(r"# (.*)\nARG EXTRAS=", DOCKERFILE)
    assert all(re.search(rf"\b{name}\b", said) for name in set(project["optional-dependencies"]) - {"dev"})


@pytest.mark.parametrize("extras", ["", "oak", "oak,metrics", "stream", "oak,Metrics", "oak,"])
def test_an_extra_that_is_none_builds_no_image(extras: str, tmp_path: Path) -> None:
    """What runs before pip, which passes over names that it does not know."""
    (check,) = re.findall(r"^RUN (\{.*\}) \\\n *&& python -m venv", DOCKERFILE, re.MULTILINE | re.DOTALL)
    check = check.replace("\\\n", "").replace("/src/", f"{CHECKOUT}/")
    (tmp_path / "python").symlink_to(sys.executable)
    environment = {"PATH": f"{tmp_path}:{os.environ['PATH']}", "EXTRAS": extras}
    done = subprocess.run(
        ["sh", "-c", check], env=environment, cwd=tmp_path, capture_output=True, text=True, timeout=60
    )
    if extras in ("", "oak", "oak,metrics"):
        assert (done.returncode, done.stderr) == (0, "")
    else:
        assert done.returncode == 1
        assert done.stderr.count("\n") == 1
        assert f"{extras.split(',')[-1]!r} is none of ['dev', 'metrics', 'oak', 'streams']" in done.stderr
