"""Where network files lie, as the environment says."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from prism_edge.depth.folders import cache_home, data_folder, download_folder, folders


@pytest.fixture(autouse=True)
def _no_settings(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for name in ("CACHE_DIRECTORY", "XDG_CACHE_HOME", "PRISM_EDGE_MODELS"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))


def test_the_cache_is_the_service_s_own_else_the_user_s(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    assert cache_home() == tmp_path / ".cache" / "prism-edge"
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert cache_home() == tmp_path / "xdg" / "prism-edge"
    monkeypatch.setenv("CACHE_DIRECTORY", os.pathsep.join(["/var/cache/prism", "/var/cache/other"]))
    assert cache_home() == Path("/var/cache/prism")
    assert folders() == [Path("/var/cache/prism/models"), data_folder()]


def test_named_folders_come_first_and_the_first_of_them_takes_downloads(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    assert download_folder() == cache_home() / "models"
    named = [tmp_path / "a", tmp_path / "b"]
    monkeypatch.setenv("PRISM_EDGE_MODELS", os.pathsep.join(["", *map(str, named)]))
    assert download_folder() == named[0]
    assert folders() == [*named, cache_home() / "models", data_folder()]
