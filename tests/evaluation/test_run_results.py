"""What an evaluation makes of what was heard: its map, its warnings, and what stays beside its results."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from prism_edge.config import BusConfig, Config, DepthConfig, LogConfig, SourceConfig
from prism_edge.config_file import load
from prism_edge.errors import BusError, ConfigError, EvaluationError
from prism_edge.evaluation import run as evaluation
from prism_edge.evaluation.recording import Recording
from prism_edge.evaluation.resources import Usage
from prism_edge.evaluation.results import FILES
from prism_edge.evaluation.run import Heard, evaluate
from prism_edge.evaluation.trajectory import NS
from prism_edge.messages import MapSnapshot, WholeMap

NONE = np.zeros(0, np.int64)
SNAPSHOT = MapSnapshot(0, 1, True, 0.0, NONE, np.zeros((0, 4, 4)), np.arange(3, dtype=np.int64))
MAP = WholeMap(0, 1, 0.0, 0.1, np.frombuffer(b"a map", np.uint8))
HEARD = Heard(Recording(), SNAPSHOT, MAP, Usage({}, {}, None, None), 1.0)


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """What the metrics were asked for; they find nothing wrong."""
    asked: dict[str, Any] = {}

    def metrics(**given: Any) -> dict[str, Any]:
        asked.update(given)
        return {"violations": [], "unscored": ""}

    monkeypatch.setattr(evaluation, "metrics", metrics)
    return asked


def score(
    monkeypatch: pytest.MonkeyPatch, sequence: Path, out: Path, heard: Heard = HEARD, **options: Any
) -> dict[str, Any]:
    """An evaluation whose daemon has run already."""
    monkeypatch.setattr(evaluation, "_run", lambda *_: heard)
    config = Config(source=SourceConfig(uri=str(sequence)), depth=DepthConfig(model="pretended"))
    return evaluate(options.pop("config", config), out, **options)


def test_the_map_lies_beside_what_it_was_scored_by(
    tiny_sequence: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, asked: dict[str, Any]
) -> None:
    report = score(monkeypatch, tiny_sequence, tmp_path)
    assert (tmp_path / "map.prismmap").read_bytes() == b"a map"
    assert json.loads((tmp_path / "metrics.json").read_text()) == report
    assert asked["first_stamp_ns"] == 100 * NS
    assert asked["truth_name"] == "the sequence's own"
    assert {file.name for file in tmp_path.iterdir()} == {*FILES} - {"daemon.log"}


@pytest.mark.parametrize(("points", "said"), [(3, True), (0, False)])
def test_a_map_that_did_not_come_is_said_where_there_was_one(
    points: int,
    said: bool,
    tiny_sequence: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    asked: dict[str, Any],
) -> None:
    heard = replace(HEARD, map=None, snapshot=replace(SNAPSHOT, points=SNAPSHOT.points[:points]))
    score(monkeypatch, tiny_sequence, tmp_path, heard)
    assert ("the map did not come in 20 s" in capsys.readouterr().err) is said
    assert not (tmp_path / "map.prismmap").exists()


@pytest.mark.parametrize("fits", range(5))
def test_what_can_not_be_written_whole_is_not_there(
    tiny_sequence: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, asked: dict[str, Any], fits: int
) -> None:
    """As many files as there is room for; and the error is the disk's, not that there is nothing to score."""
    names = ["live.tum", "final.tum", "map.prismmap", "truth.tum", "metrics.json"]
    write, room = Path.write_bytes, iter(range(fits))

    def full(path: Path, data: bytes) -> int:
        if next(room, None) is not None:
            return write(path, data)
        write(path, data[:3])
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OSError, match="No space left on device: can't write results there") as raised:
        score(monkeypatch, tiny_sequence, tmp_path)
    assert raised.value.filename == str(tmp_path)
    assert {file.name for file in tmp_path.iterdir()} == {"effective.yaml", *names[:fits]}


def test_a_figure_that_is_no_number_is_no_result(
    tiny_sequence: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """JSON has none: whoever reads the file would stumble over it."""
    monkeypatch.setattr(evaluation, "metrics", lambda **_: {"fps": float("nan")})
    with pytest.raises(ValueError, match="not JSON compliant"):
        score(monkeypatch, tiny_sequence, tmp_path)


def test_a_truth_that_would_be_overwritten_is_known_by_any_of_its_names(
    tiny_sequence: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "real")
    truth = tmp_path / "real" / "live.tum"
    truth.write_text("1 0 0 0 0 0 0 1\n")
    with pytest.raises(EvaluationError, match="would be overwritten"):
        score(monkeypatch, tiny_sequence, tmp_path / "link", truth=truth)
    assert truth.read_text() == "1 0 0 0 0 0 0 1\n"


def test_a_way_or_mask_among_the_results_is_not_overwritten(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An earlier run's path, walked once more into the same folder, would be gone before it was walked."""
    way, mask = tmp_path / "final.tum", tmp_path / "path.png"
    way.write_text("1 0 0 0 0 0 0 1\n2 1 0 0 0 0 0 1\n")
    mask.write_bytes(b"a mask")
    for source, lost in (
        (SourceConfig(uri=f"sim:room?follow={way}"), way),
        (SourceConfig(uri="sim:room", mask=str(mask)), mask),
    ):
        config = Config(source=source, depth=DepthConfig(model="pretended"))
        before = lost.read_bytes()
        with pytest.raises(EvaluationError, match=f"{lost} would be overwritten"):
            score(monkeypatch, tmp_path, tmp_path, config=config, further=["path.png"])
        assert lost.read_bytes() == before


@pytest.mark.parametrize(
    ("change", "error"), [({"robot": "a/*"}, ConfigError), ({"bus": BusConfig("nonsense")}, BusError)]
)
def test_what_no_daemon_takes_leaves_earlier_results(
    change: dict[str, Any],
    error: type[Exception],
    tiny_sequence: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    (tmp_path / "metrics.json").write_text("{}")
    config = replace(Config(source=SourceConfig(uri=str(tiny_sequence))), **change)
    with pytest.raises(error):
        score(monkeypatch, tiny_sequence, tmp_path, config=config)
    assert [file.name for file in tmp_path.iterdir()] == ["metrics.json"]


@pytest.mark.parametrize("level", ["debug", "info", "warning", "error"])
def test_what_is_to_be_known_of_the_figures_is_on_the_log_whatever_a_robot_logs(level: str) -> None:
    log = evaluation.as_it_runs(Config(log=LogConfig("journal", level))).log
    assert (log.form, log.level) == ("text", "debug" if level == "debug" else "info")


@pytest.mark.parametrize(("wait_s", "waits_s"), [(0.0, 1.0), (5.0, 5.0)])
def test_the_first_frame_waits_until_we_are_linked(
    wait_s: float,
    waits_s: float,
    tiny_sequence: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    asked: dict[str, Any],
) -> None:
    config = Config(source=SourceConfig(uri=str(tiny_sequence), wait_s=wait_s))
    score(monkeypatch, tiny_sequence, tmp_path, config=config, quiet=True)
    assert load(str(tmp_path / "effective.yaml")).source.wait_s == waits_s
