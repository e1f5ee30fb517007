"""Runs that are there are taken for new where nothing is otherwise, and nowhere else."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import onnx
import pytest

from prism_edge.sources.open import find_listing
from tests.sources import tiny_datasets as tiny
from tests.synthetic.network import write_tiny_network
from tests.tools.runs import metrics_of
from tools import finished_runs
from tools.finished_runs import finished

LATER_S = 4e9


def words_for(folder: Path, *more: str) -> list[str]:
    """An evaluation with a camera file, a pair of networks and a truth, all of an age."""
    for name in ("camera.yaml", "truth.tum"):
        (folder / name).touch()
    relative, metric = (folder / f"{name}.onnx" for name in ("relative", "metric"))
    for network in (relative, metric):
        network.touch()
        network.with_name(f"{network.name}.yaml").touch()
        network.with_name(f"{network.name}.data").touch()
    for file in folder.iterdir():
        os.utime(file, (1e9, 1e9))
    words = ["eval", "somewhere", "--out", str(folder / "run"), "--model", f"nested:{relative},{metric}"]
    words += ["--camera", str(folder / "camera.yaml"), "--truth", str(folder / "truth.tum")]
    return [*words, *more]


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """Where such a run has ended, after all its files were written."""
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "metrics.json").write_text(json.dumps(metrics_of(words_for(tmp_path))))
    return folder


def test_what_would_be_made_again_is_taken(run: Path, tmp_path: Path) -> None:
    words = words_for(tmp_path)
    assert finished(run, words) == json.loads((run / "metrics.json").read_text())
    assert finished(tmp_path / "elsewhere", words) is None


@pytest.mark.parametrize(
    ("more", "differs"),
    [
        (["--lockstep"], "mode"),
        (["--seed", "3"], "seed"),
        (["--ablate", "wls"], "ablate"),
        (["--set", "tracking.features=700"], "tracking.features"),
        (["--model", "fastdepth_nyu"], "depth.model"),
        (["--camera", "auto"], "source.camera"),
        (["--truth", "another.tum"], "the truth"),
        (["--set", "nonsense=1"], "nonsense"),
    ],
)
def test_other_settings_are_another_run(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], more: list[str], differs: str
) -> None:
    assert finished(run, words_for(tmp_path, *more)) is None
    said = capsys.readouterr().err
    assert differs in said
    assert said.count("\n") == 1


@pytest.mark.parametrize(
    "name",
    [
        *("camera.yaml", "truth.tum", "relative.onnx", "metric.onnx"),
        *("relative.onnx.yaml", "metric.onnx.yaml"),
    ],
)
def test_another_file_in_its_place_makes_another_run_whatever_its_date(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    words, file = words_for(tmp_path), tmp_path / name
    made = json.loads((run / "metrics.json").read_text())
    os.utime(file, (LATER_S, LATER_S))
    assert finished(run, words) == made, "the same file"
    other = tmp_path / "other"
    other.write_text("another")
    os.utime(other, (1e9, 1e9))
    other.rename(file)
    assert finished(run, words) is None
    assert str(file) in capsys.readouterr().err
    if file.suffix == ".yaml":  # else `eval` would say so
        file.unlink()
        assert finished(run, words) is None


def test_what_lies_beside_a_network_and_is_none_of_it_doesnt_count(run: Path, tmp_path: Path) -> None:
    words = words_for(tmp_path)
    (tmp_path / "metric.onnx.note").write_text("of one's own")
    assert finished(run, words) is not None


def test_a_link_that_leads_elsewhere_makes_another_run(run: Path, tmp_path: Path) -> None:
    words = words_for(tmp_path)
    assert finished(run, words) is not None
    (tmp_path / "elsewhere").write_text("another")
    (tmp_path / "metric.onnx").unlink()
    (tmp_path / "metric.onnx").symlink_to("elsewhere")
    assert finished(run, words) is None


def test_of_earlier_builds_a_date_has_to_do(run: Path, tmp_path: Path) -> None:
    words, file = words_for(tmp_path), run / "metrics.json"
    made = json.loads(file.read_text())
    del made["files"]
    file.write_text(json.dumps(made))
    assert finished(run, words) == made
    os.utime(tmp_path / "metric.onnx", (LATER_S, LATER_S))
    assert finished(run, words) is None


def test_a_run_in_real_time_whose_timings_are_void_is_none(run: Path, tmp_path: Path) -> None:
    words, file = words_for(tmp_path), run / "metrics.json"
    made = json.loads(file.read_text())
    file.write_text(json.dumps({**made, "foreign_cpu": None}))
    assert finished(run, words) is not None, "nobody knows"
    file.write_text(json.dumps({**made, "foreign_cpu": 0.2}))
    assert finished(run, words) is None
    words += ["--lockstep"]
    file.write_text(json.dumps({**metrics_of(words), "foreign_cpu": 0.2}))
    assert finished(run, words) is not None


def aged(folder: Path) -> Path:
    """The folder with all its files older than any run."""
    for file in (path for path in folder.rglob("*") if path.is_file()):
        os.utime(file, (1e9, 1e9))
    return folder


@pytest.mark.parametrize(
    ("write", "name"),
    [
        *((tiny.write_tum, name) for name in ("camera.yaml", "rgb.txt", "groundtruth.txt")),
        *((tiny.write_kitti, name) for name in ("calib.txt", "times.txt", "../../poses/03.txt")),
        (tiny.write_seven_scenes, "frame-000001.pose.txt"),
        (tiny.write_images, "camera.yaml"),
    ],
)
def test_a_table_of_the_recording_that_was_written_since_makes_another_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], write: Callable[[Path], Path], name: str
) -> None:
    folder, run = write(tmp_path / "sequences" / "03"), tmp_path / "run"
    if name.startswith(".."):
        (tmp_path / "poses").mkdir()
        (folder / "poses.txt").rename(tmp_path / "poses" / "03.txt")
    aged(tmp_path)
    words = ["eval", str(folder), "--out", str(run)]
    run.mkdir()
    (run / "metrics.json").write_text(json.dumps(metrics_of(words)))
    assert finished(run, words) is not None
    (folder / name).write_text((folder / name).read_text() + "\n")
    os.utime(folder / name, (LATER_S, LATER_S))
    assert finished(run, words) is None
    assert Path(name).name in capsys.readouterr().err


def test_another_camera_with_an_old_date_or_none_makes_another_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, run = aged(tiny.write_tum(tmp_path / "fr1_desk")), tmp_path / "run"
    words = ["eval", str(folder), "--out", str(run)]
    run.mkdir()
    (run / "metrics.json").write_text(json.dumps(metrics_of(words)))
    assert finished(run, words) is not None
    text = (folder / "camera.yaml").read_text()
    (folder / "camera.yaml").write_text(text.replace("fx: 60", "fx: 61"))
    aged(folder)
    assert finished(run, words) is None
    assert "the camera differ" in capsys.readouterr().err
    (folder / "camera.yaml").unlink()  # that of freiburg1 then
    assert finished(run, words) is None


@pytest.mark.parametrize(
    "write", [tiny.write_tum, tiny.write_kitti, tiny.write_seven_scenes, tiny.write_images]
)
def test_other_images_with_old_dates_make_another_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], write: Callable[[Path], Path]
) -> None:
    folder, run = aged(write(tmp_path / "desk")), tmp_path / "run"
    words = ["eval", str(folder), "--out", str(run), "--frames", "2"]
    run.mkdir()
    made = metrics_of(words)
    (run / "metrics.json").write_text(json.dumps(made))
    first, *_, last = find_listing(folder).files
    data = first.read_bytes()
    last.write_bytes(data + b"longer")
    assert finished(run, words) == made, "that one isn't played"
    first.write_bytes(data + b"longer")
    aged(folder)
    assert finished(run, words) is None
    assert "the images differ" in capsys.readouterr().err
    first.write_bytes(data)
    os.utime(first, (LATER_S, LATER_S))
    assert finished(run, words) == made, "a date says nothing of an image"
    first.write_bytes(data + b"longer")
    del made["images"]
    (run / "metrics.json").write_text(json.dumps(made))
    assert finished(run, words) == made, "earlier builds don't say which they were"


def test_a_truth_that_has_gone_makes_another_run(tmp_path: Path) -> None:
    folder, run = aged(tiny.write_tum(tmp_path / "desk")), tmp_path / "run"
    words = ["eval", str(folder), "--out", str(run)]
    run.mkdir()
    (run / "metrics.json").write_text(json.dumps(metrics_of(words)))
    assert finished(run, words) is not None
    (folder / "groundtruth.txt").unlink()
    assert finished(run, words) is None


@pytest.mark.parametrize(
    ("write", "pattern"),
    [
        (tiny.write_tum, "groundtruth.txt"),
        (tiny.write_kitti, "poses.txt"),
        (tiny.write_seven_scenes, "*.pose.txt"),
    ],
)
def test_a_truth_that_came_with_an_old_date_makes_another_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], write: Callable[[Path], Path], pattern: str
) -> None:
    folder, run = aged(write(tmp_path / "desk")), tmp_path / "run"
    poses = {path: path.read_bytes() for path in folder.glob(pattern)}
    for path in poses:
        path.unlink()
    words = ["eval", str(folder), "--out", str(run)]
    run.mkdir()
    (run / "metrics.json").write_text(json.dumps(metrics_of(words)))
    assert finished(run, words) is not None
    for path, data in poses.items():
        path.write_bytes(data)
    aged(folder)
    assert finished(run, words) is None
    assert "the truth differ" in capsys.readouterr().err
    (run / "metrics.json").write_text(json.dumps(metrics_of(words)))
    assert finished(run, words) is not None
    first = min(poses)
    first.write_bytes(poses[first] + b"\n")
    aged(folder)
    assert finished(run, words) is None


def test_a_truth_in_another_place_makes_another_run(tmp_path: Path) -> None:
    """The benchmark's own place goes before what lies with KITTI's images."""
    folder, run = tiny.write_kitti(tmp_path / "sequences" / "03"), tmp_path / "run"
    aged(tmp_path)
    words = ["eval", str(folder), "--out", str(run)]
    run.mkdir()
    made = metrics_of(words)
    (run / "metrics.json").write_text(json.dumps(made))
    assert finished(run, words) == made
    (tmp_path / "poses").mkdir()
    shutil.copy2(folder / "poses.txt", tmp_path / "poses" / "03.txt")
    assert finished(run, words) is None
    del made["truth_file"], made["files"]
    (run / "metrics.json").write_text(json.dumps(made))
    assert finished(run, words) == made, "earlier builds don't say which it was"


def test_poses_of_seven_scenes_gone_make_another_run(tmp_path: Path) -> None:
    folder, run = aged(tiny.write_seven_scenes(tmp_path / "desk")), tmp_path / "run"
    words = ["eval", str(folder), "--out", str(run)]
    run.mkdir()
    (run / "metrics.json").write_text(json.dumps(metrics_of(words)))
    first, *others = folder.glob("*.pose.txt")
    first.unlink()
    assert finished(run, words) is None
    (run / "metrics.json").write_text(json.dumps(metrics_of(words)))
    assert finished(run, words) is not None
    for path in others:
        path.unlink()
    assert finished(run, words) is None


def test_a_truth_without_a_pose_is_none(tmp_path: Path) -> None:
    folder, run = tiny.write_tum(tmp_path / "desk"), tmp_path / "run"
    (folder / "groundtruth.txt").write_text("# nothing yet\n")
    aged(folder)
    words = ["eval", str(folder), "--out", str(run)]
    run.mkdir()
    made = metrics_of(words)
    (run / "metrics.json").write_text(json.dumps(made))
    assert made["truth"] is None
    assert finished(run, words) == made


def test_a_simulated_world_has_its_truth(tmp_path: Path) -> None:
    words = ["eval", "sim:room?frames=9", "--out", str(tmp_path)]
    made = metrics_of(words)
    (tmp_path / "metrics.json").write_text(json.dumps(made))
    assert finished(tmp_path, words) == made


def test_a_card_that_has_gone_counts_where_no_file_holds_the_truth(tmp_path: Path) -> None:
    network = write_tiny_network(tmp_path / "net.onnx")
    card = network.with_name("net.onnx.yaml")
    card.write_text("name: other\n")
    words = ["eval", "sim:room?frames=9", "--model", str(network), "--out", str(tmp_path)]
    made = metrics_of(words)
    assert str(card) in made["files"]
    (tmp_path / "metrics.json").write_text(json.dumps(made))
    assert finished(tmp_path, words) == made
    card.unlink()
    assert finished(tmp_path, words) is None


def test_a_video_and_the_camera_file_beside_it_count(tmp_path: Path) -> None:
    video, run = tiny.write_video(tmp_path / "film.avi"), tmp_path / "run"
    words = ["eval", str(video), "--out", str(run)]
    run.mkdir()
    for file in (video, tmp_path / "camera.yaml"):
        aged(tmp_path)
        (run / "metrics.json").write_text(json.dumps(metrics_of(words)))
        assert finished(run, words) is not None
        os.utime(file, (LATER_S, LATER_S))
        assert finished(run, words) is None


def test_a_setting_that_is_newer_than_the_run_had_its_default(run: Path, tmp_path: Path) -> None:
    file = run / "metrics.json"
    made = json.loads(file.read_text())
    del made["config"]["tracking"]["features"], made["config"]["gate"]
    file.write_text(json.dumps(made))
    assert finished(run, words_for(tmp_path)) == made
    assert finished(run, words_for(tmp_path, "--set", "tracking.features=700")) is None
    made["config"]["tracking"]["of_old"] = 1
    file.write_text(json.dumps(made))
    assert finished(run, words_for(tmp_path)) is None, "what is no setting any more may have counted"


def test_weights_of_any_name_count(tmp_path: Path) -> None:
    """As a network's own file names them."""
    network, run = write_tiny_network(tmp_path / "net.onnx"), tmp_path / "run"
    more = {"save_as_external_data": True, "location": "weights.bin", "size_threshold": 0}
    onnx.save(onnx.load(network), network, **more)
    words = ["eval", "somewhere", "--model", str(network), "--out", str(run)]
    run.mkdir()
    (run / "metrics.json").write_text(json.dumps(metrics_of(words)))
    assert finished(run, words) is not None
    (tmp_path / "weights.bin").write_bytes(b"others")
    assert finished(run, words) is None


def test_a_run_with_nothing_to_score_is_there_for_whom_it_counts(run: Path, tmp_path: Path) -> None:
    words, file = words_for(tmp_path), run / "metrics.json"
    made = {**json.loads(file.read_text()), "unscored": "no pose"}
    file.write_text(json.dumps(made))
    assert finished_runs.metrics_there(run) == made
    assert finished(run, words, unscored=True) == made
    assert finished(run, words) is None


def test_another_version_or_a_void_run_is_none(run: Path, tmp_path: Path) -> None:
    words, file = words_for(tmp_path), run / "metrics.json"
    made = json.loads(file.read_text())
    other = {"versions": {**made["versions"], "onnxruntime": "0"}}
    for changed in (other, {"violations": ["a pose twice"]}, {"unscored": "no pose"}):
        file.write_text(json.dumps({**made, **changed}))
        os.utime(file, (LATER_S, LATER_S))
        assert finished(run, words) is None
    for cut in ('{"config": ', "[]", '{"live": {}}'):
        file.write_text(cut)
        assert finished(run, words) is None
