"""The demo: what it refuses and what it sums up. tests/test_packaging.py runs it from end to end."""

from __future__ import annotations

import signal
import threading
from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from prism_edge.bus.session import Bus
from prism_edge.cli import demo, watch
from prism_edge.cli.demo import sum_up
from prism_edge.cli.main import main
from prism_edge.cli.settings import BUNDLED
from prism_edge.config import Config, SourceConfig
from prism_edge.errors import BusError, EvaluationError
from prism_edge.evaluation import run
from prism_edge.evaluation.trajectory import Trajectory, write_tum
from prism_edge.sources import truth
from prism_edge.sources.truth import read_truth

REPORT = {
    "tracked": 99,
    "frames": 100,
    "dropped_frames": 1,
    "coverage": 0.99,
    "fps": 29.97,
    "live": {"ate_se3_m": 0.0512, "ate_sim3_m": 0.0204, "scale_ratio": 1.0 / 0.96},
    "latency_ms": {"p50": 11.04, "p99": None},
    "cpu_ms_per_frame": {"total": 40.0},
    "ready_s": 1.25,
    "timings_void": False,
}


@pytest.mark.parametrize(
    ("arguments", "file", "played"),
    [
        ([], "", demo.SOURCE),
        ([], "v4l2:/dev/video0", demo.SOURCE),
        ([], "sim:loop", "sim:loop"),
        (["--set", "source.uri=sim:stairs"], "sim:loop", "sim:stairs"),
        (["sim:room", "--set", "source.uri=sim:stairs"], "sim:loop", "sim:room"),
    ],
)
def test_it_plays_the_configuration_s_world_where_that_has_one(
    arguments, file, played, tmp_path, monkeypatch
) -> None:
    asked = []

    def play(config: Config, out: object) -> None:
        asked.append((config.source.uri, config.depth.model))
        raise EvaluationError("far enough")

    monkeypatch.setattr(demo, "play", play)
    (tmp_path / "robot.yaml").write_text(f"source:\n  uri: '{file}'\n")
    main(["demo", *arguments, "--config", str(tmp_path / "robot.yaml"), "--out", str(tmp_path / "out")])
    assert asked == [(played, BUNDLED)]


@pytest.mark.parametrize("arguments", [[], ["sim:loop"]])
def test_a_robots_camera_and_its_mount_are_not_the_simulated_ones(arguments, tmp_path, monkeypatch) -> None:
    asked = []

    def play(config: Config, out: object) -> None:
        asked.append(config)
        raise EvaluationError("far enough")

    monkeypatch.setattr(demo, "play", play)
    file = tmp_path / "robot.yaml"
    theirs = "uri: 'v4l2:/dev/video0', camera: c.yaml, mask: m.png, rate_hz: 15, frames: 90, shrink: 3"
    file.write_text(
        f"source: {{{theirs}, loop: true}}\ntracking: {{readout_ms: 30, levels: 5}}\n"
        "frames: {base_from_camera_xyzw: [0.5, 0.5, 0.5, 0.5], base_from_camera_xyz: [0.1, 0, 0]}\n"
    )
    main(["demo", *arguments, "--config", str(file), "--out", str(tmp_path / "out")])
    (config,) = asked
    assert config.source == SourceConfig(uri=arguments[0] if arguments else demo.SOURCE, frames=90)
    assert config.frames == replace(Config().frames, base_from_camera_xyz=(0.1, 0.0, 0.0))
    assert config.tracking == replace(Config().tracking, levels=5)
    main(["demo", *arguments, "--config", str(file), "--set", "tracking.readout_ms=20", "--out", "out"])
    assert asked[1].tracking.readout_ms == 20.0, "what is asked for here is meant"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["/somewhere/else"], "the demo plays simulated worlds"),
        (["rtsp://me:secret@camera/live"], "rtsp://camera/live: the demo plays simulated worlds"),
        (["--set", "source.uri=/somewhere/else"], "the demo plays simulated worlds"),
        (["sim:moon"], "no simulated world is called 'moon'"),
        (["sim:room?seed=x"], "seed must be a whole number"),
    ],
)
def test_what_it_can_not_play_is_said_in_one_line(arguments, words, tmp_path, capsys) -> None:
    assert main(["demo", *arguments, "--out", str(tmp_path / "out")]) == 4
    said = capsys.readouterr()
    assert words in said.err
    assert said.err.count("\n") == 1
    assert "secret" not in said.err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("option", "value", "code"),
    [("--endpoint", "nonsense", 6), ("--endpoint", "tcp/127.0.0.1:99999", 6), ("--robot", "a/*", 3)],
)
def test_what_no_daemon_takes_is_said_before_anything_is_shown(option, value, code, tmp_path, capsys) -> None:
    assert main(["demo", option, value, "--out", str(tmp_path / "out")]) == code
    said = capsys.readouterr()
    assert (said.out, said.err.count("\n")) == ("", 1)
    assert value in said.err
    assert not (tmp_path / "out").exists()


def test_an_unknown_network_is_said_in_one_line(tmp_path, capsys) -> None:
    assert main(["demo", "--model", "no_such_network", "--out", str(tmp_path / "out")]) == 5
    assert "no_such_network" in capsys.readouterr().err


def test_without_a_network_there_is_nothing_to_see(tmp_path, capsys) -> None:
    for given in (["--model", "none"], ["--set", "depth.model=none"]):
        assert main(["demo", *given, "--out", str(tmp_path / "out")]) == 3
        assert "needs a depth network" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_options_that_no_simulated_world_takes_are_not_offered(capsys) -> None:
    with pytest.raises(SystemExit):
        main(["demo", "--help"])
    shown = capsys.readouterr().out
    assert "--camera" not in shown
    assert "none" not in shown.replace("\n", " ").lower()
    with pytest.raises(SystemExit) as ended:
        main(["demo", "--camera", "camera.yaml"])
    assert ended.value.code == 2


def test_the_summary_gives_errors_scale_rate_and_latency(tmp_path, capsys) -> None:
    sum_up(REPORT, tmp_path, tmp_path / "path.png", 2.56)
    said = capsys.readouterr().out
    for words in ("99 of 100 frames, 1 dropped", "0.990", "30.0 Hz", "11.0, - ms", "0.0512 m", "0.0204 m"):
        assert words in said
    assert "SE(3) (2.0 % of the path's extent, 2.56 m)" in said
    assert "4.0 %" in said  # published metres are 4 % too short
    assert "say little" not in said
    assert f"{tmp_path / 'path.png'}\n" in said
    sum_up({**REPORT, "timings_void": True}, tmp_path, None, 0.0)
    said = capsys.readouterr().out
    assert "say little" in said
    assert "of the path's extent" not in said


def test_what_is_not_known_is_a_dash(tmp_path, capsys) -> None:
    live = {"ate_se3_m": None, "ate_sim3_m": None, "scale_ratio": None}
    sum_up({**REPORT, "live": live, "fps": None, "ready_s": None}, tmp_path, None, 2.56)
    said = dict(line.split(maxsplit=1) for line in capsys.readouterr().out.splitlines() if line[:1].strip())
    assert (said["rate"], said["picture"]) == ("-", "-")
    assert (said["scale"].split()[-1], said["ready"].split()[-1]) == ("-", "-")
    assert "% of the path's extent" not in said["position"]


STAMPS = np.arange(6) * 100_000_000
POSES = np.tile(np.eye(4), (6, 1, 1))
POSES[:, :3, 3] = np.outer(np.arange(6), [0.1, 0.3, 0.2])
POSES[2, 1, 3] += 0.1  # no straight line, which could be turned about itself


@pytest.fixture
def walk(monkeypatch) -> None:
    """A simulated world of a path that is known."""
    monkeypatch.setattr(truth, "read_truth", lambda uri: (STAMPS, POSES) if uri == "sim:x" else None)


def test_the_extent_is_the_longest_side(walk) -> None:
    assert demo.extent_m("sim:x", 0) == pytest.approx(1.5)
    assert demo.extent_m("sim:x", 4) == pytest.approx(0.9)
    assert demo.extent_m("sim:other", 0) == 0.0


def test_the_picture_is_from_above_and_shows_what_differs_in_size(walk, tmp_path, monkeypatch) -> None:
    drawn = []

    def draw_paths(paths, title):
        drawn.extend(paths)
        assert "5.1 cm" in title
        return np.zeros((9, 9, 3), np.uint8)

    monkeypatch.setattr("prism_edge.evaluation.draw_paths.draw_paths", draw_paths)
    half = POSES.copy()
    half[:, :3, 3] *= 0.5
    write_tum(tmp_path / "live.tum", Trajectory(STAMPS, half))
    assert demo.draw("sim:x", tmp_path, REPORT) == tmp_path / "path.png"
    assert cv2.imread(str(tmp_path / "path.png")).shape == (9, 9, 3)
    (_, _, true), (_, _, published) = drawn
    np.testing.assert_allclose(published, half[:, :2, 3], atol=1e-6)
    np.testing.assert_allclose(np.ptp(true, axis=0), np.ptp(POSES[:, :2, 3], axis=0), atol=1e-6)
    np.testing.assert_allclose(true.mean(axis=0), published.mean(axis=0), atol=1e-6)


@pytest.mark.parametrize(("poses", "error"), [(2, 0.05), (6, None)])
def test_there_is_no_picture_of_too_little(walk, poses, error, tmp_path) -> None:
    write_tum(tmp_path / "live.tum", Trajectory(STAMPS[:poses], POSES[:poses]))
    assert demo.draw("sim:x", tmp_path, {"live": {"ate_se3_m": error}}) is None
    assert not (tmp_path / "path.png").exists()


def test_sigterm_ends_it_as_such_and_is_whose_it_was_afterwards(tmp_path, monkeypatch) -> None:
    before = signal.getsignal(signal.SIGTERM)

    def played(config, out):
        signal.raise_signal(signal.SIGTERM)

    monkeypatch.setattr(demo, "play", played)
    with pytest.raises(SystemExit) as ended:
        main(["demo", "--out", str(tmp_path / "out")])
    assert ended.value.code == 143
    assert signal.getsignal(signal.SIGTERM) is before


def test_the_screen_ends_with_the_run_however_that_ends(tmp_path, monkeypatch) -> None:
    ended = []

    def failed(*_, **how):
        assert how == {"quiet": True, "keep_endpoint": True, "further": (demo.PICTURE,)}
        raise EvaluationError("it was void")

    monkeypatch.setattr(run, "evaluate", failed)
    monkeypatch.setattr(demo, "show", lambda config, over: ended.append(over.wait(4.0)))
    with pytest.raises(EvaluationError):
        demo.play(Config(source=SourceConfig(uri="sim:room?frames=9")), tmp_path)
    assert ended == [True]


@pytest.mark.filterwarnings("error::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_bus_that_can_not_be_reached_is_the_run_s_to_tell(tmp_path, monkeypatch, capsys) -> None:
    def unreachable(*_, **how):
        raise BusError("not reached")

    monkeypatch.setattr(Bus, "open", unreachable)
    monkeypatch.setattr(run, "evaluate", unreachable)
    assert main(["demo", "--out", str(tmp_path)]) == 6
    assert capsys.readouterr().err == "prism-edge: error: not reached\n"


@pytest.mark.filterwarnings("error::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_reader_that_goes_away_is_no_error(tmp_path, monkeypatch, capsys) -> None:
    def gone(*_, **how):
        raise BrokenPipeError(32, "Broken pipe")

    monkeypatch.setattr(demo, "show", gone)
    monkeypatch.setattr(run, "evaluate", lambda *_, **how: REPORT)
    assert demo.play(Config(source=SourceConfig(uri="sim:room?frames=9")), tmp_path) == REPORT
    assert capsys.readouterr().err == ""
    monkeypatch.setattr("builtins.print", gone)  # before the first word: files are wanted all the same
    assert demo.play(Config(source=SourceConfig(uri="sim:room?frames=9")), tmp_path) == REPORT


class Screen:
    """A table on a terminal, and what it was told."""

    def __enter__(self):
        return self

    def __exit__(self, *_) -> None:
        pass

    def pose(self, view) -> None:
        view.shown.append("table")


@pytest.mark.parametrize("terminal", [True, False])
def test_poses_are_a_table_on_a_terminal_and_else_a_line_a_second(terminal, capsys, monkeypatch) -> None:
    over, view = threading.Event(), SimpleNamespace(shown=[], line=lambda now_ns: "a line")
    now = iter([10.0, 10.5, 11.0, 11.5, 11.9, 12.0])

    def poses(most):
        yield from range(6)
        over.set()

    opened = []
    monkeypatch.setattr(Bus, "open", lambda config, name: opened.append(config) or Screen())
    monkeypatch.setattr(watch, "Listener", lambda bus, config: SimpleNamespace(view=view, poses=poses))
    monkeypatch.setattr(watch, "Table", Screen)
    monkeypatch.setattr(demo, "time", SimpleNamespace(monotonic=lambda: next(now), monotonic_ns=lambda: 0))
    monkeypatch.setattr("sys.stdout.isatty", lambda: terminal)
    demo.show(Config(mode="lockstep"), over)
    assert [config.mode for config in opened] == ["realtime"]  # who only looks holds nobody up
    assert view.shown == (["table"] * 6 if terminal else [])
    assert capsys.readouterr().out.splitlines() == ([] if terminal else ["a line"] * 3)


def test_a_picture_that_can_not_be_written_is_one_line(tmp_path, capsys, monkeypatch) -> None:
    """In place of a full disk: a folder of its name."""

    def played(config, out):
        (out / "path.png").mkdir(parents=True)
        write_tum(out / "live.tum", Trajectory(*read_truth(config.source.uri)))
        return REPORT

    monkeypatch.setattr(demo, "play", played)
    assert main(["demo", "--out", str(tmp_path / "out")]) == 74
    said = capsys.readouterr()
    assert said.err == f"prism-edge: error: {tmp_path / 'out' / 'path.png'}: Is a directory\n"
    assert "picture" not in said.out
