"""What the image is built from, read from its files: no container engine is needed."""

from __future__ import annotations

import re
from pathlib import Path

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
