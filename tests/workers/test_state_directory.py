"""Where maps and the journal are kept."""

from __future__ import annotations

from pathlib import Path

import pytest

from prism_edge.cli.checks import check_folders
from prism_edge.config import Config, StateConfig
from prism_edge.errors import MapError
from prism_edge.workers import state_directory


@pytest.mark.parametrize(
    ("environment", "config", "expected"),
    [
        ({"STATE_DIRECTORY": "/a:/b"}, StateConfig(), "/a"),
        ({"STATE_DIRECTORY": "/a"}, StateConfig(directory="/c"), "/c"),
        ({"XDG_STATE_HOME": "/x"}, StateConfig(), "/x/prism-edge"),
        ({"XDG_STATE_HOME": "relative", "HOME": "/h"}, StateConfig(), "/h/.local/state/prism-edge"),
        ({"HOME": "/h"}, StateConfig(), "/h/.local/state/prism-edge"),
        ({"HOME": "/h"}, StateConfig(directory="~/kept"), "/h/kept"),
    ],
)
def test_where_state_is_kept(
    environment: dict[str, str], config: StateConfig, expected: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("STATE_DIRECTORY", "XDG_STATE_HOME"):
        monkeypatch.delenv(name, raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    assert state_directory.state_directory(config) == Path(expected)


@pytest.mark.parametrize("given", ["", "/a"])
@pytest.mark.parametrize("directory", ["", "/c"])
@pytest.mark.parametrize("wanted", [True, False])
def test_a_journal_is_kept_where_state_was_given_a_folder(
    given: str, directory: str, wanted: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By the configuration or systemd, not in a user's own; `doctor` says which."""
    monkeypatch.setenv("STATE_DIRECTORY", given)
    monkeypatch.setenv("HOME", "/h")
    config = StateConfig(directory=directory, journal=wanted)
    kept = state_directory.kept_journal(config)
    assert kept == (Path(directory or given) / "journal" if wanted and (directory or given) else None)
    said = list(check_folders(Config(state=config)))[1].found
    assert said.startswith("maps and journal can" if kept else "maps can")


@pytest.mark.parametrize("name", ["lab.prismmap", ".lab", "../lab", "a/b", "", "x" * 65])
def test_a_name_that_is_none_is_refused(name: str, tmp_path: Path) -> None:
    with pytest.raises(MapError, match="is no name for a map"):
        state_directory.map_path(StateConfig(directory=str(tmp_path)), name)


def test_only_maps_are_listed_and_none_that_is_still_being_written(tmp_path: Path) -> None:
    config = StateConfig(directory=str(tmp_path))
    folder = state_directory.maps_folder(config)
    folder.mkdir()
    kitchen = state_directory.map_path(config, "kitchen")
    for path in (kitchen, folder / f".{kitchen.name}", folder / "notes.txt"):
        path.touch()
    assert state_directory.map_names(config) == ["kitchen"]


def test_a_folder_that_is_closed_to_us_has_no_maps(tmp_path: Path) -> None:
    """Here as its name is too long, since root may enter any."""
    with pytest.raises(MapError, match=r"map lab can't be read \(File name too long\)"):
        state_directory.stored_map(StateConfig(directory=str(tmp_path / ("x" * 300))), "lab")
    assert state_directory.map_names(StateConfig(directory=str(tmp_path / ("x" * 300)))) == []


def test_a_user_without_a_home_is_told_what_to_set(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("STATE_DIRECTORY", "XDG_STATE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("os.path.expanduser", lambda path: path)
    for of in (state_directory.map_names, lambda config: state_directory.map_path(config, "kitchen")):
        with pytest.raises(MapError, match=r"no home; set state\.directory"):
            of(StateConfig())
