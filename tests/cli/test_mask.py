"""`prism-edge mask`: from images to a mask that `run` takes, and refusals in one line."""

from __future__ import annotations

import os
import stat
from pathlib import Path

import cv2
import numpy as np
import pytest

from prism_edge.cli.main import main
from prism_edge.cli.mask import rate_hz
from prism_edge.sources.mask import mask_for, read_mask
from tests.synthetic.scene import block_texture

WORLD = block_texture(np.random.default_rng(0), 1200, 900)
OWN = block_texture(np.random.default_rng(1), 320, 60)


def film(folder: Path, count: int, own: bool = True, sways: float = 1.0) -> Path:
    """A folder of images, 0.5 s apart as names say nothing of time: rgb.txt does."""
    (folder / "rgb").mkdir(parents=True)
    lines = []
    for i in range(count):
        x, y = round(400 + sways * 300 * np.sin(0.9 * i)), round(300 + sways * 200 * np.sin(0.7 * i))
        image = WORLD[y : y + 240, x : x + 320].copy()
        if own:
            image[-60:] = OWN
        assert cv2.imwrite(str(folder / f"rgb/{i}.png"), image)
        lines.append(f"{0.5 * i:.6f} rgb/{i}.png\n")
    (folder / "rgb.txt").write_text("".join(lines))
    return folder


@pytest.mark.parametrize(("images", "hz"), [(40, 10 / 3), (150, 10 / 3), (600, 50 / 3), (5000, 30.0)])
def test_of_images_that_nothing_says_the_time_of_few_are_all_looked_at(
    images: int, hz: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for i in range(images):
        (tmp_path / f"{i}.png").touch()
    assert rate_hz(str(tmp_path)) == pytest.approx(hz)
    (tmp_path / "rgb.txt").write_text("".join(f"{i}.5 {i}.png\n" for i in range(images)))
    assert rate_hz(str(tmp_path)) == 0.0
    assert rate_hz("v4l2:/dev/video0") == rate_hz("sim:room") == 0.0


def test_few_images_without_stamps_are_enough(tmp_path: Path) -> None:
    recording = film(tmp_path / "film", 40) / "rgb"
    assert mask(recording, "--out", tmp_path / "mask.png") == 0
    assert mask_for(tmp_path / "mask.png", 320, 240)[-58:].mean() < 0.02


def mask(*words: object) -> int:
    return main(["mask", *map(str, words)])


def test_the_robot_is_black_in_the_mask(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "mask.png"
    recording = film(tmp_path / "film", 40)
    assert mask(recording, "--out", out) == 0
    shown = mask_for(out, 320, 240)
    assert shown[-58:].mean() < 0.02  # a corner of one colour may be left: it has nothing to be found by
    assert shown[:-75].all()
    printed = capsys.readouterr().out
    assert "of the image never moves (its middle lies at the bottom, centre)" in printed
    assert f"mask: {out}" in printed
    # What is there stays there, unless told.
    assert mask(recording, "--out", out) == 3
    assert "--overwrite" in capsys.readouterr().err
    assert mask(recording, "--out", out, "--overwrite") == 0


def test_on_a_full_disk_no_file_is_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(self: Path, data: bytes) -> int:
        raise OSError(28, "No space left on device")

    recording = film(tmp_path / "film", 40)
    monkeypatch.setattr(Path, "write_bytes", full)
    assert mask(recording, "--out", tmp_path / "mask.png") == 74
    said = f"prism-edge: error: {tmp_path / 'mask.png'}: No space left on device\n"
    assert capsys.readouterr().err == said
    assert list(tmp_path.iterdir()) == [recording]


def test_a_camera_without_a_robot_in_view_needs_none(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """What lies there of an earlier robot gives way; the mask that is written hides nothing, and is one."""
    out = tmp_path / "mask.png"
    out.write_bytes(b"an earlier robot's")
    assert mask(film(tmp_path / "film", 40, own=False), "--out", out, "--overwrite") == 0
    assert "this camera needs no mask" in capsys.readouterr().out
    assert read_mask(out).all()


def test_a_camera_that_hardly_moved_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert mask(film(tmp_path / "film", 40, sways=0.0), "--out", tmp_path / "mask.png") == 9
    assert "only 1 images differ enough" in capsys.readouterr().err


def test_where_nearly_all_stays_nothing_is_decided(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recording = film(tmp_path / "film", 60)
    for file in (recording / "rgb").iterdir():
        image = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
        image[80:] = WORLD[80:240, :320]
        cv2.imwrite(str(file), image)
    assert mask(recording, "--out", tmp_path / "mask.png") == 9
    assert "draw the mask by hand" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("out", "why"),
    [("mask.jpg", "is a PNG file"), ("nowhere/mask.png", "there is no folder"), (".", "is there already")],
)
def test_a_target_that_can_t_be_one_is_refused_before_looking(
    out: str, why: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert mask("/nowhere", "--out", tmp_path / out) == 3
    assert why in capsys.readouterr().err


def test_images_that_differ_in_size_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recording = film(tmp_path / "film", 40)
    cv2.imwrite(str(recording / "rgb/20.png"), np.zeros((100, 100), np.uint8))
    assert mask(recording, "--out", tmp_path / "mask.png") == 4
    assert "the images differ in size (320x240, then 100x100)" in capsys.readouterr().err


def test_a_pipe_and_what_is_no_file_are_left_as_they_are(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pipe = tmp_path / "mask.png"
    os.mkfifo(pipe)
    for more in ((), ("--overwrite",)):
        assert mask("/nowhere", "--out", pipe, *more) == 3
        assert "is a pipe or a device" in capsys.readouterr().err
    assert stat.S_ISFIFO(pipe.stat().st_mode)


def test_images_that_can_not_be_read_are_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recording = film(tmp_path / "film", 40)
    for i in range(2, 40):
        (recording / f"rgb/{i}.png").write_bytes(b"damaged")
    assert mask(recording, "--out", tmp_path / "mask.png") == 9
    assert "2.png is damaged" in capsys.readouterr().out
