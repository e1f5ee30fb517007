"""`prism-edge calibrate` from the command line: recordings, live cameras, refusals in one line."""

from __future__ import annotations

import itertools
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from sources.live.bench import QUICK, Bench

from prism_edge.calibration.board import Board
from prism_edge.cli import board_views
from prism_edge.cli.main import main
from prism_edge.errors import CalibrationError
from prism_edge.sources import Source
from prism_edge.sources.camera_file import read_camera
from prism_edge.sources.checks import UNCALIBRATED
from prism_edge.sources.image_folder import coverage_of
from prism_edge.sources.live.camera import LiveCamera
from prism_edge.sources.live.driver import Grab
from prism_edge.sources.open import find_listing
from tests.calibration.board_scene import PINHOLE_CAMERA, draw, gallery, poses

SPEC = "charuco:9x7"


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("board")
    for k, image in enumerate(gallery(SPEC, PINHOLE_CAMERA)[1]):
        cv2.imwrite(str(folder / f"{k}.png"), image)
    (folder / "x.png").write_bytes(b"no image")
    return folder


def calibrate(*words: object) -> int:
    return main(["calibrate", *map(str, words)])


def test_a_folder_of_images(recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "camera.yaml"
    assert calibrate(recording, "--board", SPEC, "--out", out) == 0
    camera = read_camera(out)
    assert camera.fx == pytest.approx(PINHOLE_CAMERA.fx, rel=0.003)
    assert cv2.imread(str(tmp_path / "camera.coverage.png")).shape == (480, 640, 3)
    printed = capsys.readouterr().out
    assert "reprojection error 0." in printed
    assert "board found in 16 of 16 images" in printed
    assert 50 < int(printed.partition("corners in ")[2].partition("%")[0]) < 100
    assert sorted(path.name for path in tmp_path.iterdir()) == ["camera.coverage.png", "camera.yaml"]
    # What is there stays there, unless told.
    assert calibrate(recording, "--board", SPEC, "--out", out) == 3
    assert "--overwrite" in capsys.readouterr().err
    assert calibrate(recording, "--board", SPEC, "--out", out, "--overwrite") == 0


def test_a_readout_that_the_file_had_stays(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "camera.yaml"
    out.write_text("{width: 64, height: 48, fx: 50, fy: 50, cx: 32, cy: 24, readout_ms: -17.5}")
    assert calibrate(recording, "--board", SPEC, "--out", out, "--overwrite") == 0
    camera = read_camera(out)
    assert (camera.width, camera.readout_ms) == (640, -17.5)
    assert "readout_ms of -17.5" in capsys.readouterr().out
    out.write_text("a diary")  # and what is no camera file has none
    assert calibrate(recording, "--board", SPEC, "--out", out, "--overwrite") == 0
    assert read_camera(out).readout_ms is None


def test_the_picture_is_no_image_of_the_recording(recording: Path, tmp_path: Path) -> None:
    images = sorted(recording.glob("[0-9]*.png"))
    for image in images:
        (tmp_path / image.name).write_bytes(image.read_bytes())
    assert calibrate(tmp_path, "--board", SPEC, "--out", tmp_path / "camera.yaml") == 0
    assert len(find_listing(tmp_path).files) == len(images)
    # An image of that name without a camera file is the recording's own.
    (tmp_path / "1.coverage.png").write_bytes(images[0].read_bytes())
    assert len(find_listing(tmp_path).files) == len(images) + 1


def test_a_video(recording: Path, tmp_path: Path) -> None:
    writer = cv2.VideoWriter(str(tmp_path / "v.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 30, (640, 480))
    for image in gallery(SPEC, PINHOLE_CAMERA)[1]:
        for _ in range(6):  # a fifth of a second each
            writer.write(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
    writer.release()
    out = tmp_path / "c.yaml"
    assert calibrate(tmp_path / "v.avi", "--board", SPEC, "--out", out, "--picture", tmp_path / "p.png") == 0
    assert read_camera(out).fx == pytest.approx(PINHOLE_CAMERA.fx, rel=0.003)
    assert (tmp_path / "p.png").is_file()


def refused(capsys: pytest.CaptureFixture[str], code: int, *words: object) -> str:
    assert calibrate(*words) == code
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    return error


def test_another_board_than_the_one_named(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "camera.yaml"
    error = refused(capsys, 9, recording, "--board", "charuco:9x7,6X6_50", "--out", out)
    assert "charuco:9x7,6X6_50 was found in none of 16 images" in error
    assert not out.exists()


def test_too_few_views(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("prism_edge.calibration.solve.calibrate", None)  # nothing is solved for: it'd fail
    for k, image in enumerate(gallery(SPEC, PINHOLE_CAMERA)[1][:5]):
        cv2.imwrite(str(tmp_path / f"{k}.png"), image)
    error = refused(capsys, 9, tmp_path, "--board", SPEC, "--out", tmp_path / "c.yaml")
    assert "only 5 different ways, and 10 are needed" in error
    picture = tmp_path / "c.coverage.png"  # shows why
    assert cv2.imread(str(picture)).shape == (480, 640, 3)
    (tmp_path / "c").mkdir()  # a folder is no camera file that the picture might be of
    picture.write_bytes(b"of the run before")
    refused(capsys, 9, tmp_path, "--board", SPEC, "--out", tmp_path / "c.yaml")
    assert cv2.imread(str(picture)) is not None


@pytest.mark.parametrize(("finished", "tried"), [("cam.left", "cam.right"), ("cam.yaml", "cam.yml")])
def test_the_picture_of_another_camera_stays_even_where_the_views_are_refused(
    finished: str, tried: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for k, image in enumerate(gallery(SPEC, PINHOLE_CAMERA)[1][:5]):
        cv2.imwrite(str(tmp_path / f"{k}.png"), image)
    (tmp_path / finished).write_text("a camera file")
    picture = coverage_of(tmp_path / finished)
    picture.write_bytes(b"of the camera that is done")
    refused(capsys, 9 if "left" in finished else 3, tmp_path, "--board", SPEC, "--out", tmp_path / tried)
    assert picture.read_bytes() == b"of the camera that is done"
    refused(capsys, 9, tmp_path, "--board", SPEC, "--out", tmp_path / tried, "--overwrite")
    # Neither's is a frame of the folder.
    (tmp_path / tried).write_text("a camera file")
    assert len(find_listing(tmp_path).files) == 5


def test_a_try_that_is_refused_leaves_the_camera_file_and_its_picture(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    few, out = tmp_path / "few", tmp_path / "cam.yaml"
    few.mkdir()
    for k, image in enumerate(gallery(SPEC, PINHOLE_CAMERA)[1][:5]):
        cv2.imwrite(str(few / f"{k}.png"), image)
    assert calibrate(recording, "--board", SPEC, "--out", out) == 0
    kept = {path: path.read_bytes() for path in (out, coverage_of(out))}
    error = refused(capsys, 9, few, "--board", SPEC, "--out", out, "--overwrite")
    assert {path: path.read_bytes() for path in kept} == kept
    why = tmp_path / "cam.refused.coverage.png"
    assert f"(picture: {why})" in error
    named = tmp_path / "named.png"
    named.write_bytes(b"of the camera that stays")
    refused(capsys, 9, few, "--board", SPEC, "--out", out, "--overwrite", "--picture", named)
    assert named.read_bytes() == b"of the camera that stays"
    assert cv2.imread(str(why)) is not None
    (few / "cam.yaml").write_text("")
    why.rename(few / why.name)
    assert len(find_listing(few).files) == 5, "it is no frame of the folder"
    (few / why.name).rename(why)
    assert calibrate(recording, "--board", SPEC, "--out", out, "--overwrite") == 0
    assert not why.exists()


def test_too_few_views_that_are_sharp(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    images = gallery(SPEC, PINHOLE_CAMERA)[1][:11]  # two are alike, and one is left out
    for k, image in enumerate(images):
        cv2.imwrite(str(tmp_path / f"{k}.png"), image)
    error = refused(capsys, 9, tmp_path, "--board", SPEC, "--out", tmp_path / "c.yaml")
    assert "only 9 different ways, and 10 are needed (1 that miss by far" in error


def test_a_stretched_board_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for k, image in enumerate(gallery(SPEC, PINHOLE_CAMERA)[1]):
        cv2.imwrite(str(tmp_path / f"{k}.png"), cv2.resize(image, (640, 500)))
    assert calibrate(tmp_path, "--board", SPEC, "--out", tmp_path / "c.yaml") == 0
    assert "squares are square" in capsys.readouterr().out


def test_images_of_different_sizes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cv2.imwrite(str(tmp_path / "0.png"), np.zeros((48, 64), np.uint8))
    cv2.imwrite(str(tmp_path / "1.png"), np.zeros((96, 128), np.uint8))
    assert "differ in size" in refused(capsys, 9, tmp_path, "--out", tmp_path / "c.yaml")


@pytest.mark.parametrize(
    ("words", "code", "says"),
    [
        (["sim:room"], 3, "knows its intrinsics"),
        (["/nowhere"], 4, "does not exist"),
        (["v4l2:video0"], 4, "by its path"),
        (["SOURCE", "--board", "checkers"], 3, "chessboard:9x6"),
        (["SOURCE", "--out", "/nowhere/c.yaml"], 3, "no folder"),
        (["SOURCE", "--out", "/proc/c.yaml"], 3, "can't be written"),
        (["SOURCE", "--out", "/proc", "--overwrite"], 3, "/proc"),
        (["SOURCE", "--out", "OUT/c.png", "--picture", "OUT/c.png"], 3, "both the camera file"),
        (["SOURCE", "--out", "OUT/c.png", "--picture", "OUT/in/../c.png"], 3, "both the camera file"),
    ],
)
def test_what_can_not_be_meant(
    words: list[str],
    code: int,
    says: str,
    recording: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / "in").mkdir()
    known = {"SOURCE": str(recording), "OUT/c.png": str(tmp_path / "c.png")}
    known["OUT/in/../c.png"] = str(tmp_path / "in" / ".." / "c.png")
    given = [known.get(word, word) for word in words]
    if "--out" not in given:
        given += ["--out", str(tmp_path / "c.yaml")]
    assert says in refused(capsys, code, *given)


def test_a_picture_that_the_user_named_stays_unless_told(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Only one that a refused run has left, under its own name, is replaced unasked."""
    (tmp_path / "holiday.png").write_bytes(b"mine")
    words = ("--out", tmp_path / "c.yaml", "--picture", tmp_path / "holiday.png")
    assert "give --overwrite" in refused(capsys, 3, recording, "--board", SPEC, *words)
    assert (tmp_path / "holiday.png").read_bytes() == b"mine"


def test_the_lens_that_is_named_is_looked_and_solved_for(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked: list[str] = []
    gather = board_views.gather

    def gathered(source: Source, board: Board, say: Any, model: str = "") -> board_views.Gathered:
        asked.append(model)
        return gather(source, board, say, model)

    def solved(board: Board, views: Any, width: int, height: int, model: str) -> None:
        raise CalibrationError(f"no {model} lens")

    monkeypatch.setattr(board_views, "gather", gathered)
    monkeypatch.setattr("prism_edge.calibration.solve.calibrate", solved)
    words = ("--board", SPEC, "--model", "fisheye", "--out", tmp_path / "c.yaml")
    assert "no fisheye lens" in refused(capsys, 9, recording, *words)
    assert asked == ["fisheye"]


def test_a_result_that_can_not_be_written(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(self: Path, data: bytes) -> int:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    picture = tmp_path / "c.coverage.png"
    said = refused(capsys, 74, recording, "--board", SPEC, "--out", tmp_path / "c.yaml")
    assert f"{picture}: No space left on device" in said
    assert list(tmp_path.iterdir()) == []


def live(monkeypatch: pytest.MonkeyPatch, enough: int, first: Sequence[np.ndarray] = ()) -> LiveCamera:
    """A camera before which the board is held in one place after the other."""
    monkeypatch.setattr(board_views, "_ENOUGH", enough)
    images = itertools.chain(first, itertools.cycle(gallery(SPEC, PINHOLE_CAMERA)[1]))

    def script(k: int) -> Grab:
        time.sleep(0.002)
        return Grab(time.monotonic_ns(), lambda: next(images))

    return LiveCamera(Bench(script), UNCALIBRATED, "none", QUICK)


def test_a_live_camera_until_it_is_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[str] = []
    with live(monkeypatch, 10) as camera:
        gathered = board_views.gather(camera, Board.parse(SPEC), said.append)
    assert 10 <= len(gathered.views) <= 16
    assert any("different ways" in line for line in said)
    assert len(set(said)) == len(said)  # of a view that adds nothing, nothing is said
    assert said[-1] == f"{len(gathered.views)} views"


def test_a_live_camera_is_not_let_go_on_views_that_would_be_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    board = Board.parse(SPEC)
    squarely = poses(14, board, PINHOLE_CAMERA, tilt_deg=1.0)
    images = [draw(board, PINHOLE_CAMERA, pose, k) for k, pose in enumerate(squarely)]
    said: list[str] = []
    with live(monkeypatch, 10, images) as camera:
        gathered = board_views.gather(camera, board, said.append)
    assert any("faces the camera squarely" in line for line in said)
    assert said[-1] == f"{len(gathered.views)} views"
    assert len(gathered.views) > 10
    assert len(gathered.views) < gathered.found <= gathered.looked


def test_a_live_camera_until_ctrl_c(monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[str] = []

    def say(line: str) -> None:
        said.append(line)
        if "3 views" in line:
            raise KeyboardInterrupt

    with live(monkeypatch, 100) as camera:
        gathered = board_views.gather(camera, Board.parse(SPEC), say)
    assert len(gathered.views) == 3
    assert said[-1] == "ended"


@pytest.mark.parametrize("out", [".", "/"])
def test_a_folder_is_no_camera_file(out: str, recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert out in refused(capsys, 3, recording, "--board", SPEC, "--out", out)
