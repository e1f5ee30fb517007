"""Recognising what a path holds, and finding its camera."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from pathlib import Path

import pytest
from sources import tiny_datasets as tiny
from sources.opening import all_of, opened, refusal

from prism_edge.config import SourceConfig
from prism_edge.errors import ConfigError, SourceError
from prism_edge.sources import Image, Unreadable, open_source


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


def test_a_sequence_unpacked_into_its_own_folder_is_found(tmp_path: Path) -> None:
    tiny.write_seven_scenes(tmp_path / "seq-01" / "seq-01", count=2)
    assert len(all_of(opened(tmp_path))) == 2
    tiny.write_seven_scenes(tmp_path / "seq-02" / "seq-02", count=1)
    assert "seq-01, seq-02" in str(refusal(tmp_path))


def test_a_scene_whose_sequences_are_still_packed_is_no_folder_of_one_picture(tmp_path: Path) -> None:
    tiny.write_image(tmp_path / "chess.png", tiny.picture(0))
    for name in ("seq-02.zip", "seq-01.zip"):
        (tmp_path / name).write_bytes(b"PK")
    assert "unpack seq-01.zip first" in str(refusal(tmp_path))
    tiny.write_image(tmp_path / "other.png", tiny.picture(1))  # no scene has two previews
    (tmp_path / "camera.yaml").write_text(tiny.CAMERA)
    assert len(all_of(opened(tmp_path))) == 2
    tiny.write_kitti(tmp_path / "kitti")
    (tmp_path / "kitti" / "seq-07.zip").touch()
    assert len(all_of(opened(tmp_path / "kitti"))) == 3


def test_a_kitti_sequence_of_every_fifth_image_is_played_as_it_is(tmp_path: Path) -> None:
    tiny.write_kitti(tmp_path, count=16)
    for number in range(16):
        if number % 5:
            (tmp_path / "image_0" / f"{number:06d}.png").unlink()
    assert [item.stamp_ns for item in all_of(opened(tmp_path))] == [0, 500000000, 1000000000, 1500000000]


def test_a_camera_file_may_lie_with_the_scene_or_with_its_only_sequence(tmp_path: Path) -> None:
    folder = tiny.write_seven_scenes(tmp_path / "seq-01", count=1, size=(64, 48))
    (folder / "camera.yaml").write_text(tiny.CAMERA)
    assert opened(tmp_path).camera_origin == str(folder / "camera.yaml")
    (tmp_path / "camera.yaml").write_text(tiny.CAMERA)
    assert opened(tmp_path).camera_origin == str(tmp_path / "camera.yaml")


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
    assert source.camera.readout_ms == 0.0, "of global shutters"
    assert [item.stamp_ns for item in items] == [0, 100000000, 200000000]
    assert isinstance(items[0], Image)
    assert items[0].pixels.shape == (47, 63)


def test_kitti_colour_comes_before_grey(tmp_path: Path) -> None:
    source = opened(tiny.write_kitti(tmp_path, cameras=("image_0", "image_2")))
    first = all_of(source)[0]
    assert source.camera.to_array().tolist() == [63, 47, 72, 73, 30, 22]
    assert isinstance(first, Image)
    assert first.pixels.shape == (47, 63, 3)


def test_an_empty_folder_of_colour_leaves_kittis_grey(tmp_path: Path) -> None:
    tiny.write_kitti(tmp_path)
    (tmp_path / "image_2").mkdir()
    assert len(all_of(opened(tmp_path))) == 3
    for path in (tmp_path / "image_0").iterdir():
        path.unlink()
    assert "holds no image" in str(refusal(tmp_path))


@pytest.mark.parametrize("labelled", ["image_0", "image_2"])
def test_what_lies_beside_kittis_images_is_no_image(tmp_path: Path, labelled: str) -> None:
    tiny.write_kitti(tmp_path)
    (tmp_path / labelled).mkdir(exist_ok=True)
    for i in range(3):
        (tmp_path / labelled / f"{i:06d}.txt").write_text("Car 0 0 0\n")
    items = all_of(opened(tmp_path))
    assert [(item.index, item.stamp_ns) for item in items] == [(i, i * 100_000_000) for i in range(3)]
    assert all(isinstance(item, Image) for item in items)


def test_kitti_images_that_are_missing_are_not_passed_over(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    tiny.write_kitti(tmp_path, count=6)
    for number in (0, 2, 3):
        (tmp_path / "image_0" / f"{number:06d}.png").unlink()
    items = all_of(opened(tmp_path))
    assert [item.stamp_ns for item in items] == [100000000 * k for k in range(1, 6)]
    assert [isinstance(item, Image) for item in items] == [True, False, False, True, True]
    assert "image_0 begins or ends without 1 images of times.txt" in caplog.text


@pytest.mark.parametrize(("step", "count"), [(4, 9), (4, 11), (2, 9), (2, 10), (3, 51)])
def test_a_thinned_kitti_sequence_misses_nothing(
    step: int, count: int, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    tiny.write_kitti(tmp_path, count=count)
    for number in set(range(count)) - set(range(0, count, step)):
        (tmp_path / "image_0" / f"{number:06d}.png").unlink()
    stamps = [item.stamp_ns for item in all_of(opened(tmp_path))]
    assert stamps == [number * 100_000_000 for number in range(0, count, step)]
    assert "begins or ends" not in caplog.text


def test_a_kitti_sequence_most_of_which_is_missing_was_not_thinned(tmp_path: Path) -> None:
    tiny.write_kitti(tmp_path, count=30)
    for number in range(5, 25):
        (tmp_path / "image_0" / f"{number:06d}.png").unlink()
    assert opened(tmp_path).frame_count == 30
    assert sum(isinstance(item, Unreadable) for item in all_of(opened(tmp_path))) == 20


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
        packed = Path(name).suffix.lower() not in (".bag", ".db3", ".mcap", ".klg")
        assert ("unpack it first" if packed else "write its images to files first") in str(error)
        assert name in str(error)


@pytest.mark.parametrize("name", ["cam.yaml", "run.YML", "rgb.txt", "path.tum"])
def test_a_text_file_is_no_video_whichever_camera_took_it(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text("width: 640\n")
    for settings in ({}, {"camera": "none.yaml"}, {"camera": "auto"}):
        error = refusal(tmp_path / name, **settings)
        assert isinstance(error, SourceError)
        assert f"{name} is text, no video that can be read" in str(error)
        assert ("--config" in str(error)) == (name.lower().endswith(("yaml", "yml")))


def test_what_is_empty_or_closed_to_us_is_said_before_a_camera_is_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "walk.mp4").write_bytes(b"")
    error = refusal(tmp_path / "walk.mp4")
    assert isinstance(error, SourceError)
    assert str(error).endswith("walk.mp4 is empty")

    def closed(*_: object, **__: object) -> None:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))

    monkeypatch.setattr(Path, "open", closed)  # the tests may be run by root, to whom nothing is closed
    assert str(refusal(tmp_path / "walk.mp4")).endswith("walk.mp4 can't be read (Permission denied)")


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
