"""What is said of folders that hold a dataset, but not as one can be played."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from sources import tiny_datasets as tiny

from prism_edge.errors import SourceError
from prism_edge.sources.open import find_listing
from prism_edge.sources.unrecognised import guess


def refusal(folder: Path) -> str:
    with pytest.raises(SourceError) as caught:
        find_listing(folder)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("camera", ["image_0", "image_2"])
def test_kitti_without_its_tables_names_their_download(tmp_path: Path, camera: str) -> None:
    tiny.write_kitti(tmp_path, cameras=(camera,))
    (tmp_path / "calib.txt").unlink()
    (tmp_path / "times.txt").unlink()
    message = refusal(tmp_path)
    assert f"{camera} but no calib.txt" in message
    assert "data_odometry_calib.zip" in message


def test_a_bag_of_ros_2_is_a_folder(tmp_path: Path) -> None:
    (tmp_path / "metadata.yaml").write_text("rosbag2_bagfile_information: {}\n")
    (tmp_path / "drive_0.db3").write_bytes(b"SQLite format 3\0")
    assert "write its images to files first (docs/SOURCES.md" in refusal(tmp_path)


@pytest.mark.parametrize(
    ("named", "images"), [(".", "mav0/cam0/data"), ("mav0", "cam0/data"), ("mav0/cam0", "data")]
)
def test_euroc_names_the_folder_of_its_images(tmp_path: Path, named: str, images: str) -> None:
    for name in ("cam0", "cam1"):
        tiny.write_image(tmp_path / "mav0" / name / "data" / "1403636579763555584.png", tiny.picture(0))
        (tmp_path / "mav0" / name / "sensor.yaml").write_text("sensor_type: camera\n")
    message = refusal(tmp_path / named)
    assert f"has EuRoC's images: name {images}, or" in message
    assert (tmp_path / named / images).is_dir()


def bare_kitti(folder: Path) -> Path:
    """As the images' own download unpacks."""
    tiny.write_image(folder / "image_2" / "000000.png", tiny.picture(0))
    return folder


def scene(folder: Path) -> Path:
    for name in ("seq-01", "seq-02"):
        tiny.write_seven_scenes(folder / name, count=1, size=(64, 48))
    return folder


def scene_in_its_own_folders(folder: Path) -> Path:
    tiny.write_seven_scenes(folder / "seq-01" / "seq-01", count=1, size=(64, 48))
    return folder


LAYOUTS = [
    *(tiny.write_tum, tiny.write_seven_scenes, tiny.write_kitti),
    *(bare_kitti, scene, scene_in_its_own_folders),
]


@pytest.mark.parametrize("write", LAYOUTS)
def test_a_folder_of_sequences_names_a_few(tmp_path: Path, write: Callable[[Path], Path]) -> None:
    for name in ("b2", "b10", "b1"):
        write(tmp_path / name)
    (tmp_path / "notes").mkdir()
    (tmp_path / "readme.txt").write_text("nothing")
    message = refusal(tmp_path)
    assert message.endswith("holds 3; name one of them: b1, b2, b10")
    for name in ("b3", "b4"):
        write(tmp_path / name)
    assert refusal(tmp_path).endswith("holds 5; name one of them: b1, b2, b3, b4, ...")


def test_sequences_one_folder_further_down_are_named_with_it(tmp_path: Path) -> None:
    for name in ("10", "07"):
        tiny.write_kitti(tmp_path / "dataset" / "sequences" / name)
    message = refusal(tmp_path / "dataset")
    assert message.endswith("holds 2; name one of them: sequences/07, sequences/10")


def test_a_folder_around_videos_names_them(tmp_path: Path) -> None:
    (tmp_path / "walk.MP4").write_bytes(b"any")
    (tmp_path / "._walk.MP4").write_bytes(b"of macOS")
    assert refusal(tmp_path).endswith("is no video but holds 1; name it: walk.MP4")


def test_a_folder_around_images_names_where_they_are(tmp_path: Path) -> None:
    for name in ("left", "depth_left", "notes"):
        tiny.write_images(tmp_path / name)
    for file in (tmp_path / "notes").iterdir():
        file.rename(file.with_suffix(".txt"))
    assert refusal(tmp_path).endswith("is no sequence, but images further down; name it: left")
    tiny.write_images(tmp_path / "right")
    assert refusal(tmp_path).endswith("name one of them: left, right")


@pytest.mark.parametrize("kept", ["groundtruth.txt", "depth.txt"])
def test_tum_without_its_list_says_so(tmp_path: Path, kept: str) -> None:
    tiny.write_tum(tmp_path)
    for name in ("rgb.txt", "groundtruth.txt"):
        (tmp_path / name).unlink()
    (tmp_path / kept).write_text("# none\n")
    said = refusal(tmp_path)
    assert said.endswith("has no rgb.txt, TUM's list of its images, but images further down; name it: rgb")
    assert find_listing(tmp_path / "rgb").stamped, "their names are stamps"


def test_of_other_folders_nothing_is_said(tmp_path: Path) -> None:
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "first.txt").write_text("nothing")
    assert guess(tmp_path) == ""
    message = refusal(tmp_path)
    assert "no known kind" in message
    assert "docs/SOURCES.md" in message


def test_what_can_not_be_read_is_no_sequence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tiny.write_tum(tmp_path / "a", count=1)
    (tmp_path / "locked").mkdir()
    is_dir = Path.is_dir

    def locked(path: Path) -> bool:
        if path.name == "locked":
            raise PermissionError(13, "Permission denied")
        return is_dir(path)

    monkeypatch.setattr(Path, "is_dir", locked)
    assert guess(tmp_path).endswith("holds 1; name it: a")
