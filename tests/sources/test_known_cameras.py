"""Published intrinsics, by the names of folders."""

from __future__ import annotations

import logging
from pathlib import Path

import cv2
import numpy as np
import pytest
from sources import tiny_datasets as tiny
from sources.opening import opened, refusal

from prism_edge.errors import ConfigError
from prism_edge.sources.known_cameras import by_name


@pytest.mark.parametrize(
    ("name", "fx", "coefficients"),
    [
        ("rgbd_dataset_freiburg1_desk", 517.306408, 5),
        ("rgbd_dataset_freiburg2_xyz", 520.908620, 5),
        ("rgbd_dataset_freiburg3_long_office_household", 535.4, 0),
        ("rgbd_bonn_balloon", 542.822841, 5),
        ("tartanair_hospital", 320.0, 0),
        ("new_tsukuba", 615.0, 0),
        ("fr1_desk", 517.306408, 5),
        ("TUM-fr2.xyz", 520.908620, 5),
        ("tum_fr3_walking", 535.4, 0),
        ("bonn_balloon", 542.822841, 5),
        ("Tsukuba", 615.0, 0),
    ],
)
def test_published_intrinsics_go_by_the_name(tmp_path: Path, name: str, fx: float, coefficients: int) -> None:
    for folder in (tmp_path / name, tmp_path / f"in_{name}" / "P001"):
        tiny.write_tum(folder, count=1, suffix="jpg", width=640, height=480)
        (folder / "camera.yaml").unlink()
        source = opened(folder)
        assert (source.camera.width, source.camera.height, source.camera.fx) == (640, 480, fx)
        assert len(source.camera.distortion) == coefficients


@pytest.mark.parametrize(
    ("name", "readout_ms"),
    [
        ("rgbd_dataset_freiburg1_desk", 23.0),
        ("tum-fr2_xyz", 23.0),
        ("rgbd_dataset_freiburg3_walking_xyz", None),
        ("rgbd_bonn_balloon", None),
        ("new_tsukuba", 0.0),
        ("tartanair_hospital", 0.0),
    ],
)
def test_kinects_are_read_row_by_row(tmp_path: Path, name: str, readout_ms: float | None) -> None:
    known = by_name(tmp_path / name)
    assert known is not None
    assert known[1].readout_ms == readout_ms


@pytest.mark.parametrize("name", ["bonner_weg", "sfr1", "fr10", "afr2b"])
def test_short_names_count_only_as_words(tmp_path: Path, name: str) -> None:
    folder = tiny.write_tum(tmp_path / name, count=1, suffix="jpg", width=640, height=480)
    (folder / "camera.yaml").unlink()
    assert "guess" in opened(folder).camera_origin


def test_tartanairs_images_lie_deep_below_its_name(tmp_path: Path) -> None:
    folder = tmp_path / "tartanair" / "office" / "Easy" / "P000" / "image_left"
    folder.mkdir(parents=True)
    for i in range(2):
        cv2.imwrite(str(folder / f"00000{i}_left.png"), np.zeros((480, 640, 3), np.uint8))
    source = opened(folder)
    assert source.camera.fx == 320.0
    assert "TartanAir" in source.camera_origin


@pytest.mark.parametrize(
    ("name", "fx"),
    [
        ("rgbd_dataset_freiburg1_desk/rgb", 517.306408),
        ("rgbd_dataset_freiburg3_walking_xyz/rgb", 535.4),
        ("rgbd_bonn_dataset/rgbd_bonn_crowd/rgb", 542.822841),
        ("tartanair_hospital/rgb", 320.0),
        ("data/TartanAir/office/Easy/P000/image_left", 320.0),
        ("new_tsukuba/rgb", 615.0),
    ],
)
def test_images_alone_are_a_datasets_by_its_full_name(tmp_path: Path, name: str, fx: float) -> None:
    tiny.write_image(tmp_path / name / "000001.png", tiny.picture(1, 640, 480))
    assert opened(tmp_path / name).camera.fx == fx


@pytest.mark.parametrize(
    "name",
    [
        "bonn/thesis/run3",
        "tsukuba/walk",
        "fr1",
        "tum_fr2/a",
        "freiburg1/market",
        "rgbd_bonn",
        "my_new_tsukubas",
        "rgbd_dataset_freiburg12/a",
        "notartanair",
    ],
)
def test_images_of_ones_own_are_not_taken_for_a_datasets(tmp_path: Path, name: str) -> None:
    """From Bonn, say: a town's name is no lens."""
    tiny.write_image(tmp_path / name / "000001.png", tiny.picture(1, 640, 480))
    error = refusal(tmp_path / name)
    assert isinstance(error, ConfigError)
    assert "--camera" in str(error)


def test_a_folder_that_is_left_on_the_way_has_no_say(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "tartanair_hospital").mkdir()
    monkeypatch.chdir(tmp_path / "tartanair_hospital")
    folder = tiny.write_tum(tmp_path / "office", count=1, width=640, height=480)
    (folder / "camera.yaml").unlink()
    assert "guess" in opened(Path("../office")).camera_origin
    tiny.write_image(tmp_path / "photos" / "000001.png", tiny.picture(1, 640, 480))
    assert "--camera" in str(refusal(Path("../photos")))


def test_a_link_goes_by_its_own_name_and_then_by_where_it_leads(tmp_path: Path) -> None:
    folder = tiny.write_tum(tmp_path / "rgbd_bonn_balloon", count=1, width=640, height=480)
    (folder / "camera.yaml").unlink()
    for name, fx in (("current", 542.822841), ("freiburg1_of_mine", 517.306408)):
        (tmp_path / name).symlink_to(folder)
        assert opened(tmp_path / name).camera.fx == fx


@pytest.mark.parametrize(
    ("name", "known"),
    [
        ("7scenes_redkitchen/seq-01", True),
        ("chess/seq-03", True),
        ("chess/seq-03/seq-03", True),
        ("data/7-Scenes/x", True),
        ("7scenes/a/b/c", True),
        ("apt0", False),
        ("office2", False),
        ("office/robot/runs/monday", False),
    ],
)
def test_files_called_as_those_of_7_scenes_are_its_own_by_their_folder(
    tmp_path: Path, name: str, known: bool, caplog: pytest.LogCaptureFixture
) -> None:
    """BundleFusion's recorder calls its files so, and has another camera."""
    source = opened(tiny.write_seven_scenes(tmp_path / name, count=1))
    assert source.camera.fx == 525.0
    assert ("guess" in source.camera_origin) == ("guess" in caplog.text) == (not known)
    assert source.camera.readout_ms == (0.0 if known else None), "its references take rows as read at once"


def test_an_unknown_tum_folder_is_guessed_aloud(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    folder = tiny.write_tum(tmp_path / "office", count=1, suffix="jpg", width=640, height=480)
    (folder / "camera.yaml").unlink()
    with caplog.at_level(logging.WARNING):
        source = opened(folder)
    assert (source.camera.fx, source.camera.cx, source.camera.cy) == (525.0, 319.5, 239.5)
    assert "guess" in caplog.text
    assert "guess" in source.camera_origin
