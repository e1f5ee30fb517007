"""Recordings that runs are compared with: opened once, and without a word."""

from __future__ import annotations

import logging
import os
from pathlib import Path

import pytest

from prism_edge.config import SourceConfig
from prism_edge.sources import open_source
from tests.sources import tiny_datasets as tiny
from tools import recordings_now
from tools.recordings_now import recording_now


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> list[SourceConfig]:
    """What is opened, each time."""
    given: list[SourceConfig] = []

    def open_it(source: SourceConfig) -> object:
        given.append(source)
        return open_source(source)

    monkeypatch.setattr(recordings_now, "open_source", open_it)
    return given


def test_a_recording_is_opened_once_for_each_state_of_its_files(
    tmp_path: Path, opened: list[SourceConfig]
) -> None:
    source = SourceConfig(uri=str(tiny.write_tum(tmp_path / "desk")))
    first = recording_now(source)
    assert first.camera is not None
    assert recording_now(source) is first
    assert len(opened) == 1
    stamps = tmp_path / "desk" / "rgb.txt"
    written = stamps.stat()
    stamps.write_text(stamps.read_text() + "# more\n")
    os.utime(stamps, ns=(written.st_atime_ns, written.st_mtime_ns))
    recording_now(source)
    assert len(opened) == 2
    (tmp_path / "desk" / "rgb" / "another").mkdir()
    recording_now(source)
    assert len(opened) == 3


def test_a_camera_file_elsewhere_counts(tmp_path: Path, opened: list[SourceConfig]) -> None:
    folder = tiny.write_tum(tmp_path / "desk")
    camera = (folder / "camera.yaml").rename(tmp_path / "mine.yaml")
    source = SourceConfig(uri=str(folder), camera=str(camera))
    before = recording_now(source).camera
    camera.write_text(camera.read_text().replace("fx: 60", "fx: 61") + "# measured\n")
    after = recording_now(source).camera
    assert before is not None
    assert after is not None
    assert (len(opened), before["fx"] != after["fx"]) == (2, True)


def test_nothing_is_said_and_elsewhere_everything(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tiny.write_tum(tmp_path / "desk")
    (folder / "camera.yaml").unlink()
    said: list[logging.LogRecord] = []
    listener = logging.Handler()
    monkeypatch.setattr(listener, "emit", said.append)
    monkeypatch.setattr(logging.getLogger("prism_edge.sources"), "handlers", [listener])
    source = SourceConfig(uri=str(folder))
    assert recording_now(source).camera is not None
    assert not said
    open_source(source)
    assert [record.levelname for record in said] == ["WARNING"]


def test_what_cannot_be_played_has_no_camera(tmp_path: Path) -> None:
    found = recording_now(SourceConfig(uri=str(tmp_path / "nowhere")))
    assert (found.listing, found.camera, found.truth()) == (None, None, None)
