"""Recognising what a path holds, and finding its camera."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from sources import tiny_datasets as tiny

from prism_edge.config import SourceConfig
from prism_edge.errors import ConfigError, PrismError, SourceError
from prism_edge.sources import Image, Source, Unreadable, open_source


def opened(folder: Path, **settings: object) -> Source:
    return open_source(SourceConfig(uri=str(folder), **settings))  # type: ignore[arg-type]


def all_of(source: Source) -> list[Image | Unreadable]:
    with source:
        items = []
        while (item := source.read()) is not None:
            items.append(item)
        assert source.peek() is None
        return items


def refusal(folder: Path, **settings: object) -> PrismError:
    """The error of opening; its text must be one line."""
    with pytest.raises(PrismError) as caught, opened(folder, **settings):
        pass
    assert "\n" not in str(caught.value)
    return caught.value


def test_tum(tmp_path: Path) -> None:
    source = opened(tiny.write_tum(tmp_path / "s", suffix="jpg"))
    items = all_of(source)
    assert source.frame_count == 5
    assert not source.live
    assert source.period_ns == 100_000_000
    assert [item.index for item in items] == [0, 1, 2, 3, 4]
    # stamps are exact: a float64 of this date would be off by up to 119 ns
    assert [item.stamp_ns for item in items[:2]] == [1305031102175304000, 1305031102275304000]
    assert isinstance(items[0], Image)
    assert items[0].pixels.shape == (48, 64, 3)


@pytest.mark.parametrize("suffix", ["png", "jpg"])
def test_seven_scenes(tmp_path: Path, suffix: str) -> None:
    source = opened(tiny.write_seven_scenes(tmp_path, suffix=suffix))
    items = all_of(source)
    assert (source.camera.fx, source.camera.cx, source.camera.cy) == (525.0, 320.0, 240.0)
    assert "7-Scenes" in source.camera_origin
    assert [item.stamp_ns for item in items] == [0, 33333333, 66666667, 100000000]


def test_seven_scenes_stamps_follow_the_frame_numbers(tmp_path: Path) -> None:
    folder = tiny.write_seven_scenes(tmp_path)
    (folder / "frame-000001.color.png").unlink()
    items = all_of(opened(folder))
    assert [(item.index, item.stamp_ns) for item in items] == [(0, 0), (1, 66666667), (2, 100000000)]


def test_the_only_sequence_of_a_scene_is_meant(tmp_path: Path) -> None:
    tiny.write_seven_scenes(tmp_path / "seq-03", count=2)
    (tmp_path / "seq-04").mkdir()  # empty: no choice
    assert len(all_of(opened(tmp_path))) == 2


@pytest.mark.parametrize("write", [tiny.write_images, tiny.write_seven_scenes, tiny.write_kitti])
def test_what_macos_notes_beside_images_is_none(tmp_path: Path, write: Callable[[Path], Path]) -> None:
    count = len(all_of(opened(write(tmp_path))))
    for path in list(tmp_path.rglob("*.png")):
        path.with_name(f"._{path.name}").write_bytes(b"\x00\x05\x16\x07")
    assert len(all_of(opened(tmp_path))) == count


def test_of_several_sequences_one_must_be_named(tmp_path: Path) -> None:
    tiny.write_seven_scenes(tmp_path / "seq-01", count=1)
    tiny.write_seven_scenes(tmp_path / "seq-02", count=1)
    error = refusal(tmp_path)
    assert isinstance(error, SourceError)
    assert "seq-01, seq-02" in str(error)


def test_kitti_grey(tmp_path: Path) -> None:
    source = opened(tiny.write_kitti(tmp_path))
    items = all_of(source)
    # calib.txt gives no size, so it is the images' own, odd as it may be
    assert source.camera.to_array().tolist() == [63, 47, 70, 71, 31, 23]
    assert [item.stamp_ns for item in items] == [0, 100000000, 200000000]
    assert isinstance(items[0], Image)
    assert items[0].pixels.shape == (47, 63)


def test_kitti_colour_comes_before_grey(tmp_path: Path) -> None:
    source = opened(tiny.write_kitti(tmp_path, cameras=("image_0", "image_2")))
    first = all_of(source)[0]
    assert source.camera.to_array().tolist() == [63, 47, 72, 73, 30, 22]
    assert isinstance(first, Image)
    assert first.pixels.shape == (47, 63, 3)


@pytest.mark.parametrize(
    ("file", "content", "words"),
    [
        ("times.txt", "0\n0.1\n", ["times.txt", "too few", "000002.png"]),
        ("times.txt", "0\n0.1\nsoon\n", ["times.txt line 3"]),
        ("times.txt", "0\n0.1 0.2\n0.3\n", ["times.txt line 2"]),
        ("calib.txt", "P1: 1 0 0 0 0 1 0 0 0 0 1 0\n", ["calib.txt", "P0"]),
        ("calib.txt", "P0: 1 0 0\n", ["calib.txt line 1", "12"]),
        ("calib.txt", "P0: a b c d e f g h i j k l\n", ["calib.txt line 1", "12"]),
        ("calib.txt", "P0: -7 0 31 0 0 71 23 0 0 0 1 0\n", ["calib.txt line 1", "focal"]),
    ],
)
def test_damaged_kitti_tables(tmp_path: Path, file: str, content: str, words: list[str]) -> None:
    tiny.write_kitti(tmp_path)
    (tmp_path / file).write_text(content)
    message = str(refusal(tmp_path))
    for word in words:
        assert word in message


def test_kitti_without_times(tmp_path: Path) -> None:
    tiny.write_kitti(tmp_path)
    (tmp_path / "times.txt").unlink()
    message = str(refusal(tmp_path))
    assert "image_0 but no times.txt" in message
    assert "data_odometry_calib.zip" in message


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


@pytest.mark.parametrize(
    "names",
    [
        ["1403636579763555", "1403636579813555", "1403636579863555"],  # microseconds
        ["0000000000000000", "0000000000000001", "0000000000000002"],
        ["1403636579763555584"],  # nothing to compare it with
        ["1403636579763555584", "1403636579813555584", "cover"],
        ["140363657976355558", "1403636579813555584", "1403636579863555584"],
        ["9403636579763555584", "9403636579813555584"],  # beyond what ROS can hold
        ["140363657976355", "140363659976355"],
    ],
)
def test_names_that_may_be_something_else_are_no_stamps(tmp_path: Path, names: list[str]) -> None:
    for i, name in enumerate(names):
        tiny.write_image(tmp_path / f"{name}.png", tiny.picture(i))
    (tmp_path / "camera.yaml").write_text(tiny.CAMERA)
    stamps = [item.stamp_ns for item in all_of(opened(tmp_path))]
    assert stamps == [round(i * 1e9 / 30) for i in range(len(names))]


def test_one_stamp_twice_is_none(tmp_path: Path) -> None:
    for i, name in enumerate(("63555584.png", "63555584.jpg", "113555584.png")):
        tiny.write_image(tmp_path / f"1403636579{name:0>13}", tiny.picture(i))
    (tmp_path / "camera.yaml").write_text(tiny.CAMERA)
    assert all_of(opened(tmp_path))[0].stamp_ns == 0


def test_a_datasets_own_stamps_are_kept_at_any_rate(tmp_path: Path) -> None:
    items = all_of(opened(tiny.write_tum(tmp_path), rate_hz=5.0))
    assert items[1].stamp_ns - items[0].stamp_ns == 100_000_000


def test_images_and_videos_without_a_camera_are_refused(tmp_path: Path) -> None:
    for path in (tiny.write_images(tmp_path / "images"), tiny.write_video(tmp_path / "v" / "clip.avi")):
        folder = path if path.is_dir() else path.parent
        (folder / "camera.yaml").unlink()
        error = refusal(path)
        assert isinstance(error, ConfigError)
        assert "--camera" in str(error)


@pytest.mark.parametrize(
    "name", ["seq-01.zip", "a.tgz", "a.tar", "a.tar.gz", "a.7z", "a.bag", "a.db3", "a.mcap", "A.KLG"]
)
def test_what_is_still_packed_is_said_to_be(tmp_path: Path, name: str) -> None:
    """Before a camera is asked for, which would not help."""
    (tmp_path / name).write_bytes(b"\0" * 100)
    for settings in ({}, {"camera": "none.yaml"}, {"camera": "auto"}):
        error = refusal(tmp_path / name, **settings)
        assert isinstance(error, SourceError)
        assert "unpack it first" in str(error)
        assert name in str(error)


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


def test_an_unknown_tum_folder_is_guessed_aloud(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    folder = tiny.write_tum(tmp_path / "office", count=1, suffix="jpg", width=640, height=480)
    (folder / "camera.yaml").unlink()
    with caplog.at_level(logging.WARNING):
        source = opened(folder)
    assert (source.camera.fx, source.camera.cx, source.camera.cy) == (525.0, 319.5, 239.5)
    assert "guess" in caplog.text
    assert "guess" in source.camera_origin


def test_camera_files_win_over_the_table_and_the_option_over_all(tmp_path: Path) -> None:
    folder = tiny.write_tum(tmp_path / "freiburg1", count=1)
    assert opened(folder).camera.fx == 60.0
    assert "camera.yaml" in opened(folder).camera_origin
    (folder / "camera.yaml").rename(folder / "camera_info.yaml")
    assert opened(folder).camera.fx == 60.0
    other = tmp_path / "other.yaml"
    other.write_text(tiny.CAMERA.replace("fx: 60", "fx: 61"))
    source = opened(folder, camera=str(other))
    assert source.camera.fx == 61.0
    assert "other.yaml" in source.camera_origin


def test_a_camera_of_another_size_is_refused_with_both_sizes(tmp_path: Path) -> None:
    folder = tiny.write_tum(tmp_path / "s")
    other = tmp_path / "half.yaml"
    other.write_text("width: 32\nheight: 24\nfx: 30\nfy: 30\ncx: 15.5\ncy: 11.5\n")
    for path in (folder, tiny.write_video(tmp_path / "v" / "clip.avi")):
        error = refusal(path, camera=str(other))
        assert isinstance(error, ConfigError)
        assert "32x24" in str(error)
        assert "64x48" in str(error)


def test_missing_or_broken_camera_files(tmp_path: Path) -> None:
    folder = tiny.write_tum(tmp_path / "s")
    assert isinstance(refusal(folder, camera=str(tmp_path / "none.yaml")), ConfigError)
    (folder / "camera.yaml").write_text(tiny.CAMERA.replace("fx: 60", "fx: 0"))
    error = refusal(folder)
    assert isinstance(error, ConfigError)
    assert "camera.yaml" in str(error)


def test_nothing_recognised_lists_what_would_be(tmp_path: Path) -> None:
    empty = tmp_path / "empty"
    empty.mkdir()
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "readme.txt").write_text("nothing")
    for path in (empty, tmp_path / "notes", tmp_path / "missing"):
        error = refusal(path)
        assert isinstance(error, SourceError)
        assert str(path) in str(error)
        for layout in ("TUM", "7-Scenes", "KITTI", "folder of images", "video"):
            assert layout in str(error)
    with pytest.raises(SourceError, match="no source given"):
        open_source(SourceConfig())


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ("", ["holds no image"]),
        ("# only a comment\n", ["holds no image"]),
        ("0.1 rgb/a.png extra\n", ["line 1"]),
        ("# c\nsoon rgb/a.png\n", ["line 2", "soon"]),
        ("nan rgb/a.png\n", ["line 1"]),
        ("1e400 rgb/a.png\n", ["line 1"]),
        ("inf rgb/a.png\n", ["line 1"]),
    ],
)
def test_damaged_tum_lists(tmp_path: Path, table: str, words: list[str]) -> None:
    folder = tiny.write_tum(tmp_path)
    (folder / "rgb.txt").write_text(table)
    message = str(refusal(folder))
    for word in words:
        assert word in message


def test_a_binary_list_is_refused(tmp_path: Path) -> None:
    folder = tiny.write_tum(tmp_path)
    (folder / "rgb.txt").write_bytes(b"\xff\x00\x80")
    assert "rgb.txt" in str(refusal(folder))


@pytest.mark.parametrize("suffix", ["png", "jpg"])
def test_images_in_the_middle_that_are_broken_or_missing(tmp_path: Path, suffix: str) -> None:
    folder = tiny.write_tum(tmp_path, count=7, suffix=suffix)
    files = sorted((folder / "rgb").iterdir())
    tiny.truncate(files[1])
    files[2].unlink()
    files[3].write_bytes(b"")
    files[4].write_bytes(b"not an image at all")
    files[5].unlink()
    files[5].mkdir()
    items = all_of(opened(folder))
    assert [item.index for item in items] == list(range(7))
    assert [isinstance(item, Image) for item in items] == [True] + [False] * 5 + [True]
    reasons = [item.reason for item in items if isinstance(item, Unreadable)]
    for reason, path, word in zip(
        reasons, files[1:6], ["truncated", "missing", "empty", "no image", "can't be read"], strict=True
    ):
        assert path.name in reason
        assert word in reason


def test_the_first_image_may_be_broken_but_not_all(tmp_path: Path) -> None:
    folder = tiny.write_tum(tmp_path, count=3)
    files = sorted((folder / "rgb").iterdir())
    tiny.truncate(files[0])
    assert len(all_of(opened(folder))) == 3
    for path in files[1:]:
        tiny.truncate(path)
    error = refusal(folder)
    assert isinstance(error, SourceError)
    assert "no readable image" in str(error)
    kitti = tiny.write_kitti(tmp_path / "kitti")
    for path in (kitti / "image_0").iterdir():
        tiny.truncate(path)
    assert "no readable image" in str(refusal(kitti))


def test_skipping_and_opening_again(tmp_path: Path) -> None:
    source = opened(tiny.write_tum(tmp_path))
    with source:
        source.skip()
        slot, item = source.peek(), source.read()
        assert slot is not None
        assert item is not None
        assert (slot.index, slot.stamp_ns) == (item.index, item.stamp_ns) == (1, 1305031102275304000)
    assert source.read() is None  # closed
    assert len(all_of(source)) == 5
