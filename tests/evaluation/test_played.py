"""What a run was made of, as every layout has it."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from prism_edge.config import SourceConfig
from prism_edge.evaluation.played import Played, played
from prism_edge.sources import open_source
from tests.sources import tiny_datasets as tiny


def of(uri: Path | str, truth: Path | None = None, camera: str = "") -> Played:
    config = SourceConfig(uri=str(uri), camera=camera)
    return played(config, open_source(config), truth)


@pytest.mark.parametrize(
    ("write", "layout", "truth", "origin"),
    [
        (tiny.write_tum, "TUM RGB-D", "groundtruth.txt", "{}/camera.yaml"),
        (tiny.write_seven_scenes, "7-Scenes", ".", "colour as of any Kinect (7-Scenes)"),
        (tiny.write_kitti, "KITTI odometry", "poses.txt", "P0 of calib.txt"),
        (tiny.write_images, "folder of images", "", "{}/camera.yaml"),
    ],
)
def test_layout_truth_and_camera_of_a_folder(
    write: Callable[[Path], Path], layout: str, truth: str, origin: str, tmp_path: Path
) -> None:
    folder = write(tmp_path / "chess")
    found = of(folder)
    assert found.layout == layout
    assert found.truth_file == (str(folder / truth) if truth else None)
    assert found.camera is not None
    assert found.camera["origin"] == origin.format(folder)
    assert not found.guessed


def test_the_truth_of_kittis_own_tree_is_found(tmp_path: Path) -> None:
    folder = tiny.write_kitti(tmp_path / "sequences" / "03")
    (tmp_path / "poses").mkdir()
    poses = (folder / "poses.txt").rename(tmp_path / "poses" / "03.txt")
    assert of(folder).truth_file == str(poses)


def test_seven_scenes_without_a_pose_file_has_no_truth(tmp_path: Path) -> None:
    folder = tiny.write_seven_scenes(tmp_path)
    first, *others = sorted(folder.glob("*.pose.txt"))
    first.unlink()
    assert of(folder).truth_file == str(folder)
    for pose in others:
        pose.unlink()
    assert of(folder).truth_file is None


def test_images_are_known_by_name_and_size_wherever_they_lie(tmp_path: Path) -> None:
    folder = tiny.write_seven_scenes(tmp_path / "desk")
    copy = Path(shutil.copytree(folder, tmp_path / "elsewhere" / "copy"))
    images = of(folder).images
    assert images is not None
    assert of(copy).images == images
    image = copy / "frame-000001.color.png"
    image.write_bytes(image.read_bytes() + b"longer")
    assert of(copy).images != images


def test_an_image_that_is_missing_in_between_makes_other_images(tmp_path: Path) -> None:
    """KITTI's numbers say that there is one, which is then played as unreadable."""
    folder = tiny.write_kitti(tmp_path, count=6)
    whole = of(folder).images
    (folder / "image_0" / "000003.png").unlink()
    assert of(folder).images not in (None, whole)


def test_another_truth_is_named_in_its_place(tmp_path: Path) -> None:
    assert of(tiny.write_tum(tmp_path), tmp_path / "mine.tum").truth_file == str(tmp_path / "mine.tum")


def test_a_camera_that_nobody_named_is_a_guess(tmp_path: Path) -> None:
    folder = tiny.write_tum(tmp_path / "desk")
    (folder / "camera.yaml").unlink()
    found = of(folder)
    assert found.guessed
    assert found.camera is not None
    assert (found.camera["width"], found.camera["fx"], found.camera["distortion"]) == (640, 525.0, ())


def test_an_estimated_camera_is_what_the_daemon_says(tmp_path: Path) -> None:
    found = of(tiny.write_tum(tmp_path), camera="auto")
    log = tmp_path / "daemon.log"
    for written in (None, "nothing"):
        if written is not None:
            log.write_text(written)
        assert found.after(log).camera == {
            "origin": "auto",
            **dict.fromkeys(("model", "width", "height", "fx", "fy", "cx", "cy", "distortion", "readout_ms")),
        }
    log.write_text("source: folder x; camera: as net sees it in 5 images: f 500.0, 501.0\nmore\n")
    after = found.after(log).camera
    assert after is not None
    assert after["origin"] == "auto: as net sees it in 5 images: f 500.0, 501.0"


def test_a_camera_that_was_calibrated_stays_whatever_the_daemon_says(tmp_path: Path) -> None:
    log = tmp_path / "daemon.log"
    log.write_text("source: folder x; camera: as net sees it in 5 images: f 500.0, 501.0\n")
    found = of(tiny.write_tum(tmp_path / "tum"))
    assert found.after(log) == found
    assert Played().after(log) == Played()


def test_a_rolling_shutter_that_its_images_show_is_a_doubt_of_its_camera(tmp_path: Path) -> None:
    log = tmp_path / "daemon.log"
    said = "rolling shutter: rows are read over 25.2 ms longer than is known, sigma 2.1, 19 keyframes: tell"
    none = "rolling shutter: none for sure but what is known (rows are read over 0.2 ms longer than is known)"
    log.write_text(f"09:18:17.166 INFO    backend: {none}\n09:19:45.077 WARNING backend: {said}\n")
    assert Played().after(log).doubts == (said,)
    log.write_text(f"09:18:17.166 INFO    backend: {none}\n")
    assert Played().after(log).doubts == ()


def test_a_video_that_was_cut_short_is_doubted(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    film = tiny.write_video(tmp_path / "film.avi", count=20)
    tiny.truncate(film, 0.5)
    with open_source(SourceConfig(uri=str(film))) as source:
        while source.read():
            pass
    (said,) = caplog.messages
    log = tmp_path / "daemon.log"
    log.write_text(f"09:18:17.166 INFO    source: ready\n09:18:19.077 WARNING source: {said}\n")
    assert Played().after(log).doubts == (said,)
    assert "should last 1.0 s" in said


def test_videos_and_simulated_worlds_have_no_file_of_truth(tmp_path: Path) -> None:
    video = of(tiny.write_video(tmp_path / "film.avi"))
    assert (video.layout, video.truth_file, video.images) == ("video file", None, None)
    simulated = of("sim:room?frames=9")
    assert (simulated.layout, simulated.truth_file) == ("simulator", None)


def test_a_folder_that_lacks_images_at_its_end_is_said(tmp_path: Path) -> None:
    folder = tiny.write_kitti(tmp_path / "sequences" / "03")
    assert not of(folder).doubts
    max(folder.glob("image_0/*")).unlink()
    max(folder.glob("image_0/*")).unlink()
    said = (f"{folder}: image_0 begins or ends without 2 images of times.txt",)
    assert of(folder).doubts == said
    assert of(folder).after(tmp_path / "no.log").doubts == said


def test_bonns_camera_without_bonns_name_is_said_where_its_own_truth_counts(tmp_path: Path) -> None:
    folder = tiny.write_tum(tmp_path / "bonn" / "balloon")
    (said,) = of(folder).doubts
    assert "taken for the camera's poses, not the markers'" in said
    assert not of(folder, truth=folder / "groundtruth.txt").doubts
    assert not of(tiny.write_tum(tmp_path / "bonn" / "rgbd_bonn_balloon")).doubts


def test_true_poses_that_lie_beside_a_folder_of_images_are_said(tmp_path: Path) -> None:
    folder = tiny.write_tum(tmp_path / "rgbd_dataset_freiburg1_desk")
    assert not of(folder).doubts
    (said,) = of(folder / "rgb").doubts
    assert said.startswith(f"{folder / 'groundtruth.txt'} is not read")
    assert not of(folder / "rgb", truth=folder / "groundtruth.txt").doubts


def test_images_of_seven_scenes_that_are_missing_are_said(tmp_path: Path) -> None:
    folder = tiny.write_seven_scenes(tmp_path / "chess", count=8)
    assert not of(folder).doubts
    for number in (3, 4):
        next(folder.glob(f"frame-00000{number}.color.*")).unlink()
    (said,) = of(folder).doubts
    assert "2 images are missing in between" in said
