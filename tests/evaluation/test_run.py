"""A whole evaluation over the real bus, against a daemon whose every word is known."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest

from prism_edge.config import BusConfig, Config, DepthConfig, SourceConfig
from prism_edge.config_file import load
from prism_edge.errors import BusError, ConfigError, EvaluationError, SourceError
from prism_edge.evaluation import run as evaluation
from prism_edge.evaluation.daemon import DaemonError
from prism_edge.evaluation.run import evaluate, extent
from prism_edge.evaluation.scores import score
from prism_edge.evaluation.trajectory import NS, read_tum
from prism_edge.sources import open_source, sim
from tests.waiting import until

FAKE = Path(__file__).with_name("fake_daemon.py")
ROOT = FAKE.parents[2]


def config_for(sequence: Path) -> Config:
    return Config(source=SourceConfig(uri=str(sequence)), depth=DepthConfig(model="pretended"))


def run(scenario: str, sequence: Path, out: Path, **options: Any) -> dict[str, Any]:
    return evaluate(config_for(sequence), out, command=(sys.executable, str(FAKE), scenario), **options)


@pytest.fixture(autouse=True)
def _importable(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", str(ROOT))


@pytest.fixture(autouse=True)
def _nothing_left() -> Any:
    before = set(psutil.Process().children())  # of other tests: multiprocessing keeps a tracker
    yield
    assert set(psutil.Process().children()) <= before
    for thread in threading.enumerate():
        if thread.name == "recorder":
            thread.join(10.0)
            assert not thread.is_alive()


def test_a_pause_in_the_stamps_is_waited_for_and_silence_is_not(
    tiny_sequence: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(evaluation, "_SILENCE_S", 1.5)
    assert run("pauses", tiny_sequence, tmp_path / "pauses")["frames"] == 24
    with pytest.raises(EvaluationError, match="no frame was tracked for"):
        run("stalls", tiny_sequence, tmp_path / "stalls")


def test_a_run_is_recorded_and_scored(tiny_sequence: Path, tmp_path: Path) -> None:
    found = run("normal", tiny_sequence, tmp_path)
    assert json.loads(json.dumps(found)) == json.loads((tmp_path / "metrics.json").read_text())
    assert (found["frames"], found["tracked"], found["dropped_frames"]) == (24, 21, 0)
    assert found["coverage"] == pytest.approx(21 / 24)
    assert found["duplicate_frames"] == 3
    assert found["first_pose_s"] == pytest.approx(1 / 30, abs=1e-5)
    assert found["ready_s"] > 0
    assert found["latency_ms"]["p50"] > 0
    assert found["fps"] > 0
    assert found["final_settled"] is True
    assert (found["keyframes"], found["map_points"]) == (2, 0)
    assert found["final_missing"] == 1  # the frame whose keyframe the map does not hold
    for name in ("live", "final"):
        assert found[name]["ate_sim3_m"] == pytest.approx(0.0, abs=1e-6)
        assert found[name]["scale_ratio"] == pytest.approx(2.0, rel=1e-6)
        assert found[name]["ate_se3_m"] > 0.1
    assert found["scale"] == {
        "log_scale": pytest.approx(np.log(0.5)), "sigma_log": 0.11, "filter_sigma_log": 0.05, "metric": True
    }
    assert {"supervisor", "total"} <= set(found["cpu_ms_per_frame"])
    assert found["peak_pss_mb"]["total"] > 1.0
    assert found["truth"] == "the sequence's own"
    assert found["truth_file"] == str(tiny_sequence / "groundtruth.txt")
    assert found["files"] == {
        found["truth_file"]: hashlib.sha256((tiny_sequence / "groundtruth.txt").read_bytes()).hexdigest()
    }
    assert found["layout"] == "TUM RGB-D"
    assert found["camera"] == {
        **{"origin": str(tiny_sequence / "camera.yaml"), "model": "pinhole", "width": 64, "height": 48},
        **{"fx": 60.0, "fy": 60.0, "cx": 31.5, "cy": 23.5, "distortion": [], "readout_ms": None},
    }
    effective = load(str(tmp_path / "effective.yaml"))
    assert effective.source.uri == str(tiny_sequence)
    assert effective.bus.endpoint != Config().bus.endpoint


def test_a_recording_s_extent_is_read_from_it(tiny_sequence: Path) -> None:
    first, frames = extent(SourceConfig(uri=str(tiny_sequence)))
    assert first is not None
    assert (first.index, first.stamp_ns, frames) == (0, 100 * NS, 24)


def test_a_recording_begins_with_the_first_stamp_that_can_be_right(
    tiny_sequence: Path, tmp_path: Path
) -> None:
    folder = shutil.copytree(tiny_sequence, tmp_path / "late")
    lines = (folder / "rgb.txt").read_text().splitlines()
    rows = [line.split() for line in lines if not line.startswith("#")]
    stamps = [0.0, *(1305031100.0 + float(stamp) for stamp, _ in rows[1:])]
    listed = (f"{stamp:.6f} {image}\n" for stamp, (_, image) in zip(stamps, rows, strict=True))
    (folder / "rgb.txt").write_text("".join(listed))
    first, frames = extent(SourceConfig(uri=str(folder)))
    assert first is not None
    assert first.stamp_ns > NS
    assert (first.index, frames) == (1, len(rows))


@pytest.mark.parametrize("world", ["room", "loop"])
def test_a_simulated_world_is_not_built_to_learn_its_extent(world: str, monkeypatch: Any) -> None:
    uri = f"sim:{world}"
    with monkeypatch.context() as patch:
        patch.setattr(sim.source, "build_world", None)  # calling it would fail
        first, frames = extent(SourceConfig(uri=uri))
    source = open_source(SourceConfig(uri=uri))
    assert first is not None
    assert (first.index, first.stamp_ns, frames) == (0, 0, source.frame_count)


def test_a_recording_that_can_t_be_played_is_refused_before_the_run(tmp_path: Path) -> None:
    with pytest.raises(SourceError):
        extent(SourceConfig(uri=str(tmp_path / "nowhere")))
    with pytest.raises(SourceError):
        extent(SourceConfig(uri="sim:nowhere"))


def test_a_recording_that_begins_again_has_no_end_to_score(tiny_sequence: Path, tmp_path: Path) -> None:
    config = config_for(tiny_sequence)
    looped = replace(config, source=replace(config.source, loop=True))
    with pytest.raises(ConfigError, match=r"source\.loop: .* ends with its recording"):
        evaluate(looped, tmp_path / "o", command=(sys.executable, str(FAKE), "good"))
    assert not (tmp_path / "o").exists()


def test_a_map_taken_up_lies_where_its_maker_began_it(tiny_sequence: Path, tmp_path: Path) -> None:
    """Its first camera was mounted otherwise: `live.tum` and `final.tum` are in one `map` all the same."""
    run("loaded", tiny_sequence, tmp_path)
    live, final = read_tum(tmp_path / "live.tum"), read_tum(tmp_path / "final.tum")
    both = np.isin(live.stamps, final.stamps)
    np.testing.assert_allclose(final.poses, live.poses[both], atol=1e-6)


def test_files_hold_the_cameras_pose_under_the_recordings_stamps(tiny_sequence: Path, tmp_path: Path) -> None:
    run("normal", tiny_sequence, tmp_path)
    live, final = read_tum(tmp_path / "live.tum"), read_tum(tmp_path / "final.tum")
    assert live.stamps[0] == 100 * NS + 33_333_000
    i = np.round((live.stamps - 100 * NS) / NS * 30)
    np.testing.assert_allclose(live.positions[:, 0], i / 30, atol=1e-6)
    np.testing.assert_allclose(live.poses[:, :3, :3], np.tile(np.eye(3), (len(live), 1, 1)), atol=1e-6)
    assert len(live) == 21
    shared = live.at(np.isin(live.stamps, final.stamps))
    np.testing.assert_allclose(final.poses, shared.poses, atol=1e-6)


def test_another_truth_may_be_given(tiny_sequence: Path, tmp_path: Path) -> None:
    truth = tmp_path / "half.tum"
    lines = [line.split() for line in (tiny_sequence / "groundtruth.txt").read_text().splitlines()]
    truth.write_text(
        "".join(f"{w[0]} {float(w[1]) / 2} {float(w[2]) / 2} 0 0 0 0 1\n" for w in lines), encoding="ascii"
    )
    found = run("normal", tiny_sequence, tmp_path / "out", truth=truth)
    assert found["live"]["scale_ratio"] == pytest.approx(1.0, rel=1e-5)
    assert found["truth"] == str(truth)


def test_the_truth_lies_beside_what_it_scores(tiny_sequence: Path, tmp_path: Path) -> None:
    found = run("normal", tiny_sequence, tmp_path)
    truth, live = read_tum(tmp_path / "truth.tum"), read_tum(tmp_path / "live.tum")
    assert len(truth) == 24
    np.testing.assert_allclose(truth.positions[:, 0], np.arange(24) / 15, atol=1e-6)
    assert score(live, truth).ate_se3_m == pytest.approx(found["live"]["ate_se3_m"], abs=1e-6)
    before = (tmp_path / "truth.tum").read_text()
    given = tmp_path / "truth.tum"
    given.write_text("# mine\n" + before)
    again = run("normal", tiny_sequence, tmp_path, truth=given)
    assert again["live"] == found["live"]
    assert given.read_text() == "# mine\n" + before, "what was given stays as it is"


def test_results_that_can_not_be_written_are_the_file_s_fault(tiny_sequence: Path, tmp_path: Path) -> None:
    (tmp_path / "out").write_text("a file")
    with pytest.raises(OSError, match="can't write results there") as raised:
        run("normal", tiny_sequence, tmp_path / "out")
    assert raised.value.filename == str(tmp_path / "out")


@pytest.mark.parametrize("name", ["live.tum", "final.tum"])
def test_a_truth_that_the_run_would_overwrite_is_refused(
    name: str, tiny_sequence: Path, tmp_path: Path
) -> None:
    (tmp_path / name).write_text("1 0 0 0 0 0 0 1\n")
    with pytest.raises(EvaluationError, match="would be overwritten"):
        run("normal", tiny_sequence, tmp_path, truth=tmp_path / name)
    assert (tmp_path / name).read_text() == "1 0 0 0 0 0 0 1\n"


def test_without_truth_none_of_an_earlier_run_is_left(tiny_sequence: Path, tmp_path: Path) -> None:
    sequence = shutil.copytree(tiny_sequence, tmp_path / "sequence")
    (sequence / "groundtruth.txt").unlink()
    out = tmp_path / "out"
    out.mkdir()
    (out / "truth.tum").write_text("of another\n")
    assert run("normal", sequence, out)["truth"] is None
    assert not (out / "truth.tum").exists()


@pytest.mark.parametrize("own", [True, False])
def test_a_damaged_truth_is_found_before_the_run(own: bool, tiny_sequence: Path, tmp_path: Path) -> None:
    sequence = shutil.copytree(tiny_sequence, tmp_path / "sequence")
    bad = sequence / "groundtruth.txt" if own else tmp_path / "given.tum"
    bad.write_text("100.0 nan 0 0 0 0 0 1\n")
    with pytest.raises(SourceError if own else EvaluationError, match=bad.name):
        run("normal", sequence, tmp_path / "out", truth=None if own else bad)
    assert not (tmp_path / "out" / "daemon.log").exists()


def test_a_pose_while_lost_voids_the_run_but_files_are_there(tiny_sequence: Path, tmp_path: Path) -> None:
    with pytest.raises(EvaluationError, match="while lost"):
        run("lost", tiny_sequence, tmp_path)
    assert json.loads((tmp_path / "metrics.json").read_text())["violations"]
    assert len(read_tum(tmp_path / "live.tum")) == 23
    assert (tmp_path / "final.tum").exists()


def test_a_run_without_a_pose_can_t_be_scored_but_files_are_there(
    tiny_sequence: Path, tmp_path: Path
) -> None:
    with pytest.raises(EvaluationError, match="can't be scored: no pose came out of 24 frames"):
        run("silent", tiny_sequence, tmp_path)
    assert json.loads((tmp_path / "metrics.json").read_text())["tracked"] == 0
    assert (tmp_path / "final.tum").exists()


def test_a_truth_of_another_time_can_t_score_a_run(tiny_sequence: Path, tmp_path: Path) -> None:
    truth = tmp_path / "later.tum"
    truth.write_text("".join(f"{900 + i} 0 0 {i} 0 0 0 1\n" for i in range(9)))
    with pytest.raises(EvaluationError, match="can't be scored: 0 of 21 poses have a true one"):
        run("normal", tiny_sequence, tmp_path / "out", truth=truth)
    assert json.loads((tmp_path / "out" / "metrics.json").read_text())["tracked"] == 21


def test_a_map_that_never_settles_is_taken_as_it_is_and_said_so(tiny_sequence: Path, tmp_path: Path) -> None:
    found = run("unsettled", tiny_sequence, tmp_path, settle_s=0.3)
    assert found["final_settled"] is False
    assert found["final"]["pairs"] == 20


@pytest.mark.parametrize(
    ("scenario", "code", "words"), [("refuses", 5, "no such file"), ("dies", 7, "out of luck")]
)
def test_a_daemon_that_fails_gives_its_words_and_code(
    scenario: str, code: int, words: str, tiny_sequence: Path, tmp_path: Path
) -> None:
    with pytest.raises(DaemonError, match=words) as caught:
        run(scenario, tiny_sequence, tmp_path)
    assert caught.value.exit_code == code
    assert not (tmp_path / "metrics.json").exists()


def test_a_run_without_a_network_says_that_no_pose_will_come(
    tiny_sequence: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Before it runs; without, the log of the daemon alone would say so."""
    bare = Config(source=SourceConfig(uri=str(tiny_sequence)))
    command = (sys.executable, str(FAKE), "refuses")
    for quiet, said in ((False, True), (True, False)):
        with pytest.raises(DaemonError):
            evaluate(bare, tmp_path, command=command, quiet=quiet)
        assert ("warning: depth has no network" in capsys.readouterr().err) == said


EARLIER = ("live.tum", "map.prismmap", "metrics.json", "path.png")


def with_earlier_results(folder: Path) -> Path:
    for name in EARLIER:
        (folder / name).write_text("earlier")
    (folder / "effective.yaml").write_text("robot: earlier\n")
    return folder


def test_what_never_begins_costs_no_results_of_an_earlier_run(tiny_sequence: Path, tmp_path: Path) -> None:
    with_earlier_results(tmp_path)
    with pytest.raises(DaemonError):
        run("refuses", tiny_sequence, tmp_path, further=("path.png",))
    assert all((tmp_path / name).read_text() == "earlier" for name in EARLIER)
    assert (tmp_path / "effective.yaml").read_text() == "robot: earlier\n", "whose results lie beside it"
    assert "no such file" in (tmp_path / "daemon.log").read_text(), "what was said last is there"


def test_where_another_daemon_is_its_poses_are_not_ours(tiny_sequence: Path, tmp_path: Path) -> None:
    with_earlier_results(tmp_path)
    before = {file.name: file.read_bytes() for file in tmp_path.iterdir()}
    with socket.create_server(("127.0.0.1", 0)) as another:
        taken = BusConfig(endpoint=f"tcp/127.0.0.1:{another.getsockname()[1]}")
        with pytest.raises(BusError, match="is in use already"):
            evaluate(replace(config_for(tiny_sequence), bus=taken), tmp_path, keep_endpoint=True)
    assert {file.name: file.read_bytes() for file in tmp_path.iterdir()} == before


@pytest.mark.parametrize("further", [(), ("path.png",)])
def test_results_of_an_earlier_run_do_not_survive_one_that_fails_on_its_way(
    further: tuple[str, ...], tiny_sequence: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Nor what was made of them; what is somebody else's stays, and so do the poses that had come."""
    with_earlier_results(tmp_path)
    with pytest.raises(DaemonError, match="out of luck"):
        run("dies", tiny_sequence, tmp_path, further=further)
    left = {"effective.yaml", "daemon.log", "live.tum", "path.png"} - set(further)
    assert {file.name for file in tmp_path.iterdir()} == left
    assert load(tmp_path / "effective.yaml").source.uri == str(tiny_sequence)
    came = read_tum(tmp_path / "live.tum")
    assert 1 <= len(came) <= 5
    assert f"its {len(came)} poses are in {tmp_path / 'live.tum'}" in capsys.readouterr().err


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_ended_from_outside_it_takes_the_daemon_along(
    number: signal.Signals, tiny_sequence: Path, tmp_path: Path
) -> None:
    # Where the tests run in a shell's background, SIGINT is ignored from the start, by heirs too.
    code = f"""
import functools, signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)
from prism_edge.evaluation import run
run.evaluate = functools.partial(run.evaluate, command=(sys.executable, {str(FAKE)!r}, "unsettled"))
from prism_edge.cli.main import main
sys.exit(main(["eval", {str(tiny_sequence)!r}, "--model", "prism_nano", "--out", {str(tmp_path)!r}]))
"""
    evaluation = subprocess.Popen([sys.executable, "-c", code], cwd=ROOT, stderr=subprocess.PIPE, text=True)
    started = psutil.Process(evaluation.pid)
    until(lambda: _listening(started), "the pretended daemon has a child")
    log = tmp_path / "daemon.log"
    until(lambda: log.exists() and "asked for its map" in log.read_text(), "all frames have been played")
    family = started.children(recursive=True)
    os.kill(evaluation.pid, number)
    _, errors = evaluation.communicate(timeout=30)
    assert evaluation.returncode == (130 if number == signal.SIGINT else 128 + number)
    assert "Traceback" not in errors
    assert len(read_tum(tmp_path / "live.tum")) == 21, "what has come is kept"
    assert psutil.wait_procs(family, timeout=10)[1] == []


def _listening(process: psutil.Process) -> bool:
    """Whether the pretended daemon is far enough to have a child of its own."""
    return len(process.children(recursive=True)) >= 2
