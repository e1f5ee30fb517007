"""Plain folders of images: their order, and when they were taken."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pytest
from sources import tiny_datasets as tiny
from sources.opening import all_of, opened

from prism_edge.config import SourceConfig
from prism_edge.sources import Image, open_source
from prism_edge.sources.open import find_listing


def test_a_folder_of_images_is_in_natural_order(tmp_path: Path) -> None:
    source = opened(tiny.write_images(tmp_path))
    items = all_of(source)
    assert [item.stamp_ns for item in items[:3]] == [0, 33333333, 66666667]
    for i, item in enumerate(items):
        assert isinstance(item, Image)
        assert (item.pixels == tiny.picture(i + 1)).all()


def test_a_folder_of_images_is_stamped_at_the_rate_asked_for(tmp_path: Path) -> None:
    items = all_of(opened(tiny.write_images(tmp_path), rate_hz=5.0))
    assert [item.stamp_ns for item in items[:2]] == [0, 200_000_000]


def test_images_without_stamps_are_assumed_to_come_at_30_hz_aloud(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folder = tiny.write_images(tmp_path)
    with caplog.at_level(logging.WARNING):
        opened(folder)
    (record,) = caplog.records
    assert "30 Hz" in record.getMessage()
    assert "source.rate_hz" in record.getMessage()
    caplog.clear()
    opened(folder, rate_hz=30.0)
    open_source(SourceConfig(uri=str(folder)), calibrated=False)  # to calibrate: no rate matters
    opened(tiny.write_tum(tmp_path / "tum"))
    assert not caplog.records


def test_names_that_are_nanoseconds_are_stamps(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """EuRoC's mav0/cam0/data, whose images are a twentieth of a second apart."""
    first, step = 1403636579763555584, 50_000_128
    for i in range(4):
        tiny.write_image(tmp_path / f"{first + i * step}.png", tiny.picture(i))
    (tmp_path / "camera.yaml").write_text(tiny.CAMERA)
    for rate_hz in (0.0, 30.0):
        source = opened(tmp_path, rate_hz=rate_hz)
        assert [item.stamp_ns for item in all_of(source)] == [first + i * step for i in range(4)]
        assert source.period_ns == step
    assert not caplog.records


def test_names_that_are_seconds_are_stamps(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """TUM's and BONN's folder rgb without its list, whether or not zeros at the end are written."""
    names = ["1305031102.775304", "1305031102.88", "1305031102.9", "1305031103.000001"]
    for i, name in enumerate(names):
        tiny.write_image(tmp_path / f"{name}.png", tiny.picture(i))
    (tmp_path / "camera.yaml").write_text(tiny.CAMERA)
    items = all_of(opened(tmp_path))
    assert [item.stamp_ns for item in items] == [
        *(1305031102_775304000, 1305031102_880000000, 1305031102_900000000, 1305031103_000001000)
    ]
    for i, item in enumerate(items):
        assert isinstance(item, Image)
        assert (item.pixels == tiny.picture(i)).all()
    assert not caplog.records


def test_a_second_whose_point_was_left_out_too_is_a_stamp(tmp_path: Path) -> None:
    for i, name in enumerate(("1548266469.9", "1548266469.95", "1548266470", "1548266470.05")):
        tiny.write_image(tmp_path / f"{name}.png", tiny.picture(i))
    (tmp_path / "camera.yaml").write_text(tiny.CAMERA)
    items = all_of(opened(tmp_path))
    after_ms = [(item.stamp_ns - 1548266469_900000000) / 1e6 for item in items]
    assert after_ms == [0.0, 50.0, 100.0, 150.0]
    for i, item in enumerate(items):
        assert isinstance(item, Image)
        assert (item.pixels == tiny.picture(i)).all()


@pytest.mark.parametrize(
    "names",
    [
        ["0.05", "0.1", "0.15", "0.2", "0.25", "1.0", "9.95", "10.0"],  # simulated time
        ["1548266469.88333", "1548266469.9", "1548266470.01666", "preview"],  # stamps beside a stranger
        ["1.1", "1.6", "1.11", "1.16", "1.21"],  # every fifth image of a scene
        ["1.8", "1.9", "1.11"],
        ["1.9", "1.10", "1.11"],  # the second scene's tenth image
        ["1.1", "1.9", "1.10"],  # the same number twice
        ["2", "10", "100"],
    ],
)
def test_decimals_in_names_are_played_in_the_order_of_time(tmp_path: Path, names: list[str]) -> None:
    for name in names:
        tiny.write_image(tmp_path / f"{name}.png", tiny.picture(0))
    assert [path.stem for path in find_listing(tmp_path).files] == names


@pytest.mark.parametrize(
    "names",
    [
        ["1403636579763555", "1403636579813555", "1403636579863555"],  # microseconds
        ["1403636579000000", "1403636580000000", "1403636581000000"],  # ... of an image a second
        ["0000000000000000", "0000000000000001", "0000000000000002"],
        ["1403636579763555584"],  # nothing to compare it with
        ["1403636579763555584", "1403636579813555584", "cover"],
        ["140363657976355558", "1403636579813555584", "1403636579863555584"],
        ["9403636579763555584", "9403636579813555584"],  # beyond what ROS can hold
        ["140363657976355", "140363659976355"],
        ["1403636579.1", "1403636579.10"],  # one moment twice
        ["1403636579.763555", "1403636579.813555", "cover"],
        ["0000000001.5", "0000000001.50001"],  # too near each other
        ["1.5", "2.5"],  # versions, scales, or seconds of who knows what
    ],
)
def test_names_that_may_be_something_else_are_no_stamps(tmp_path: Path, names: list[str]) -> None:
    for i, name in enumerate(names):
        tiny.write_image(tmp_path / f"{name}.png", tiny.picture(i))
    (tmp_path / "camera.yaml").write_text(tiny.CAMERA)
    stamps = [item.stamp_ns for item in all_of(opened(tmp_path))]
    assert stamps == [round(i * 1e9 / 30) for i in range(len(names))]


def test_what_our_own_tools_leave_there_is_no_frame(tmp_path: Path) -> None:
    """One name of another length, and nanoseconds would be none any more."""
    first, step = 1403636579763555584, 50_000_128
    for i in range(4):
        tiny.write_image(tmp_path / f"{first + i * step}.png", tiny.picture(i))
    for name in ("mask.png", "camera.coverage.png"):  # of a calibration that was refused
        tiny.write_image(tmp_path / name, tiny.picture(9))
    (tmp_path / "left.yaml").write_text(tiny.CAMERA)
    items = all_of(opened(tmp_path, camera=str(tmp_path / "left.yaml")))
    assert [item.stamp_ns for item in items] == [first + i * step for i in range(4)]


def test_a_picture_of_coverage_is_none_by_the_camera_file_beside_it(tmp_path: Path) -> None:
    """What calibrate calls it goes by the camera file; beside none, it is somebody's own picture."""
    for name in ("1.png", "left.png", "left.coverage.png"):
        tiny.write_image(tmp_path / "images" / name, tiny.picture(1))
    (tmp_path / "camera.yaml").write_text(tiny.CAMERA)
    folder, camera = tmp_path / "images", str(tmp_path / "camera.yaml")
    assert len(all_of(opened(folder, camera=camera))) == 3
    (folder / "left.yaml").write_text(tiny.CAMERA)
    assert len(all_of(opened(folder, camera=camera))) == 2


@pytest.mark.parametrize("name", ["depth{:06d}.png", "{:06d}-depth.png", "{:06d}.Depth.png"])
def test_depth_beside_colour_is_no_frame(tmp_path: Path, name: str) -> None:
    """As Replica and RGB-D Scenes have it; all would be one recording, half of it no pictures."""
    for i in range(3):
        tiny.write_image(tmp_path / f"frame{i:06d}.png", tiny.picture(i))
        tiny.write_image(tmp_path / name.format(i), np.full((48, 64), 1000 + i, np.uint16))
    (tmp_path / "camera.yaml").write_text(tiny.CAMERA)
    items = all_of(opened(tmp_path))
    assert len(items) == 3
    assert all(isinstance(item, Image) and item.pixels.ndim == 3 for item in items)


def test_a_folder_of_nothing_else_is_played_as_it_is(tmp_path: Path) -> None:
    for i in range(3):
        tiny.write_image(tmp_path / f"in_depth_{i}.png", tiny.picture(i))
    (tmp_path / "camera.yaml").write_text(tiny.CAMERA)
    assert len(all_of(opened(tmp_path))) == 3


def test_one_stamp_twice_is_none(tmp_path: Path) -> None:
    for i, name in enumerate(("63555584.png", "63555584.jpg", "113555584.png")):
        tiny.write_image(tmp_path / f"1403636579{name:0>13}", tiny.picture(i))
    (tmp_path / "camera.yaml").write_text(tiny.CAMERA)
    assert all_of(opened(tmp_path))[0].stamp_ns == 0
