"""What ~ stands for in names of files."""

from __future__ import annotations

from pathlib import Path

import pytest

from prism_edge.named_path import named_path


def test_a_home_is_put_in_its_place(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", "/home/robot")
    assert named_path("~/maps") == Path("/home/robot/maps")
    for name in ("maps", "/srv/maps", "maps/~"):
        assert named_path(name) == Path(name)


def test_nobodys_home_is_a_name_like_any_other() -> None:
    assert named_path("~no-such-user/camera.yaml") == Path("~no-such-user/camera.yaml")
