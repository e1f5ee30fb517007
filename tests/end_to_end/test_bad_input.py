"""Bad input through the command line: one clear line, the documented exit code, nothing left running."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from prism_edge.evaluation.trajectory import read_tum
from tests.end_to_end.conftest import FRAMES, HEIGHT, WIDTH
from tests.end_to_end.processes import DEADLINE_S, Daemon, prism_edge, rows
from tests.synthetic.network import TinyNetwork, save, tiny_graph, write_tiny_network
from tests.waiting import until

CONFIG, SOURCE, MODEL, BUS = 3, 4, 5, 6  # exit codes, as `prism-edge --help` lists them


def write(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def wrong_input(path: Path) -> Path:
    """A sound network whose description names an input that it hasn't got."""
    what = TinyNetwork()
    save(path, tiny_graph(what), replace(what.card(), input_name="picture"))
    return path


Options = Callable[[Path], tuple[str | Path, ...]]
REFUSED: dict[str, tuple[int, str, Options]] = {
    "missing sequence": (SOURCE, "does not exist", lambda d: (d / "none",)),
    "empty sequence": (SOURCE, "empty", lambda d: (d,)),
    "camera with fx 0": (
        CONFIG,
        "fx",
        lambda d: ("--camera", write(d / "c.yaml", "width: 320\nheight: 240\nfx: 0\nfy: 1\ncx: 1\ncy: 1\n")),
    ),
    "camera of an unknown model": (
        CONFIG,
        "model",
        lambda d: (
            "--camera",
            write(d / "c.yaml", "model: magic\nwidth: 320\nheight: 240\nfx: 1\nfy: 1\ncx: 1\ncy: 1\n"),
        ),
    ),
    "camera of another size": (
        CONFIG,
        "320x240",
        lambda d: ("--camera", write(d / "c.yaml", "width: 64\nheight: 48\nfx: 9\nfy: 9\ncx: 32\ncy: 24\n")),
    ),
    "unknown key": (
        CONFIG,
        "feature",
        lambda d: ("--config", write(d / "c.yaml", "tracking:\n  feature: 1000\n")),
    ),
    "text where a number belongs": (
        CONFIG,
        "tracking.features",
        lambda d: ("--config", write(d / "c.yaml", "tracking:\n  features: many\n")),
    ),
    "1e-8 where a whole number belongs": (
        CONFIG,
        "tracking.features",
        lambda d: ("--config", write(d / "c.yaml", "tracking:\n  features: 1e-8\n")),
    ),
    "no ONNX": (MODEL, "net.onnx", lambda d: ("--model", write(d / "net.onnx", "not a network"))),
    "missing model": (MODEL, "absent.onnx", lambda d: ("--model", d / "absent.onnx")),
    "model with the wrong input": (MODEL, "picture", lambda d: ("--model", wrong_input(d / "net.onnx"))),
    "robot name": (CONFIG, "robot", lambda d: ("--robot", "a/*")),
    "malformed endpoint": (BUS, "bus.endpoint", lambda d: ("--endpoint", "tcp/nowhere")),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_can_not_work_is_refused_in_one_line(
    case: str, room: Path, camera: Path, network: Path, tmp_path: Path
) -> None:
    code, words, options = REFUSED[case]
    given = options(tmp_path)
    if not str(given[0]).startswith("--"):
        line: tuple[str | Path, ...] = (*given, "--model", network)
    else:
        ours = {"--camera": camera, "--model": network, given[0]: given[1]}
        line = (room, *(word for pair in ours.items() for word in pair))
    done = prism_edge("run", *line)
    errors = [said for said in done.stderr.splitlines() if ": error: " in said]
    assert done.returncode == code, done.stderr
    assert len(errors) == 1, done.stderr
    assert words in errors[0]
    assert "Traceback" not in done.stderr
    assert done.stdout == ""


def test_a_number_that_yaml_itself_takes_for_text_is_a_number(tmp_path: Path) -> None:
    done = prism_edge("config", "--config", write(tmp_path / "c.yaml", "scale:\n  drift_per_sqrt_m: 1e-8\n"))
    assert done.returncode == 0, done.stderr
    assert "drift_per_sqrt_m: 1.0e-08" in done.stdout or "drift_per_sqrt_m: 1e-08" in done.stdout


@pytest.fixture
def damaged(room: Path, tmp_path: Path) -> tuple[Path, set[int]]:
    """The room with every damage that a recording may have; and the indices of images that can't be used."""
    folder = tmp_path / "damaged"
    shutil.copytree(room / "rgb", folder / "rgb")
    lines = [line.split() for line in (room / "rgb.txt").read_text().splitlines()[1:]]
    images = [folder / name for _, name in lines]
    images[20].write_bytes(images[20].read_bytes()[:3000])  # truncated PNG
    jpeg = cv2.imencode(".jpg", cv2.imread(str(images[24])))[1].tobytes()
    images[24].write_bytes(jpeg[: len(jpeg) // 2])  # truncated JPEG
    images[28].write_bytes(b"")
    images[32].unlink()
    cv2.imwrite(str(images[36]), np.zeros((HEIGHT // 2, WIDTH // 2, 3), np.uint8))  # of another size
    lines[40][0] = lines[39][0]  # a stamp that repeats
    lines[44][0] = lines[30][0]  # a stamp that goes back
    for copy in (48, 49):  # exact copies of their predecessor
        shutil.copy(images[47], images[copy])
    (folder / "rgb.txt").write_text("".join(f"{stamp} {name}\n" for stamp, name in lines))
    shutil.copy(room / "groundtruth.txt", folder)
    return folder, {20, 24, 28, 32, 36, 40, 44}


def test_a_damaged_recording_is_played_and_its_damages_counted(
    damaged: tuple[Path, set[int]], camera: Path, network: Path, tmp_path: Path
) -> None:
    folder, unusable = damaged
    out = tmp_path / "out"
    done = prism_edge("eval", folder, "--camera", camera, "--model", network, "--out", out, "--lockstep")
    assert done.returncode == 0, done.stderr
    report = json.loads((out / "metrics.json").read_text())
    assert report["frames"] == FRAMES
    assert report["unreadable_frames"] == len(unusable)
    assert report["duplicate_frames"] == 2
    assert report["dropped_frames"] == 0
    assert report["tracked"] >= FRAMES - len(unusable) - 5
    assert report["live"]["ate_se3_m"] < 0.03
    live = read_tum(out / "live.tum")
    stamps = [round(float(f"{i / 30:.6f}") * 1e9) for i in (47, 48, 49)]
    carried = [live.poses[list(live.stamps).index(stamp)] for stamp in stamps]
    # Nothing moved; corrections of the map may.
    assert np.abs(carried[1] - carried[0]).max() < 0.01
    assert np.abs(carried[2] - carried[0]).max() < 0.01
    log = (out / "daemon.log").read_text()
    assert "Traceback" not in log
    for kind in ("unreadable", "wrong_size", "bad_stamps"):
        assert f"0 {kind}" not in log
    assert log.count("not released") == 3  # a line for each kind, not for each image


@pytest.mark.parametrize("misbehaviour", ["nan", "zero", "negative"])
def test_a_network_gone_wrong_is_reported_and_counted_and_the_daemon_runs_on(
    misbehaviour: str, long_room: Path, camera: Path, tmp_path: Path, daemon: Callable[..., Daemon]
) -> None:
    network = write_tiny_network(tmp_path / "bad.onnx", TinyNetwork(misbehaviour=misbehaviour))
    running = daemon(long_room, "--camera", camera, "--model", network).until_ready()
    with running.bus() as bus:
        health = bus.queue("health")
        seen: list[dict[str, dict[str, str]]] = []

        def counted() -> bool:
            seen.extend(rows(message) for message in health.drain())
            depth = seen[-1]["depth"] if seen else {}
            said = depth.get("level") == "1" and "no usable depth" in depth["message"]
            return said and int(depth.get("invalid", "0")) > 0

        until(counted, "unusable depth is counted and said")
        assert seen[-1]["depth"]["restarts"] == "0"
        scale = bus.ask("scale", DEADLINE_S)
        assert scale is None or not scale.metric
    until(lambda: "has no depth" in running.log, "unusable depth is logged")
    assert not [process for process in running.family if not process.is_running()]
