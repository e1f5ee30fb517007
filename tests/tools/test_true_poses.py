"""True poses of images: at the image's own time, whatever clock the poses have."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from prism_edge.evaluation.trajectory import NS, Trajectory, read_tum, write_tum
from prism_edge.geometry.poses import from_rt, so3_exp
from prism_edge.sources.truth import read_truth
from tests.synthetic.sequence import write_sequence
from tools import fit_gate, make_kidnapping, make_variant, measure_cloud, measure_places
from tools.true_poses import own_truth, pose_of_image

SPEED = 0.5  # m/s along x, and rad/s about z


def captured(rate_hz: float, begin_s: float = 0.0, end_s: float = 2.0) -> Trajectory:
    times = np.arange(begin_s, end_s, 1.0 / rate_hz)
    return Trajectory.of((round(t * NS), pose(t)) for t in times)


def pose(time_s: float) -> np.ndarray:
    return from_rt(so3_exp(np.array([0.0, 0.0, SPEED * time_s])), np.array([SPEED * time_s, 0.0, 0.0]))


def test_between_two_poses_of_motion_capture_it_is_interpolated() -> None:
    truth = captured(100.0, begin_s=0.0023)
    for stamp in (round(k * NS / 30) for k in range(1, 59)):
        assert pose_of_image(truth, stamp) == pytest.approx(pose(stamp / NS), abs=1e-5)


def test_a_sparse_reference_tells_of_its_own_images_alone() -> None:
    truth = captured(3.0)
    assert pose_of_image(truth, NS // 30) is None
    assert pose_of_image(truth, truth.stamps[3] + 400) == pytest.approx(truth.poses[3], abs=1e-6)
    assert pose_of_image(truth, truth.stamps[-1] + 400) == pytest.approx(truth.poses[-1])  # rounded
    assert pose_of_image(truth, truth.stamps[-1] + NS // 200) is None  # nothing behind it
    assert pose_of_image(Trajectory.of([]), 0) is None


@pytest.fixture
def filmed(tmp_path: Path) -> Path:
    """Images at 30 Hz whose true poses are 100 a second and have no stamp in common with them."""
    folder = write_sequence(tmp_path / "in", frames=9, width=64, height=48)
    write_tum(folder / "groundtruth.txt", captured(100.0, begin_s=-0.0077, end_s=0.6))
    return folder


def expected(count: int) -> np.ndarray:
    return np.array([pose(k / 30) for k in range(count)])


def test_a_kidnapping_has_the_pose_of_each_image(filmed: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    make_kidnapping.write(str(filmed), out, (3, 5), 0.0, 9, filmed / "groundtruth.txt")
    stamps, poses = read_truth(str(out))
    assert poses == pytest.approx(expected(9), abs=1e-5)
    reference = read_tum(out / "reference.tum")
    assert reference.stamps.tolist() == [stamps[k] for k in range(9) if not 3 <= k < 5]
    assert reference.poses == pytest.approx(np.delete(expected(9), [3, 4], axis=0), abs=1e-5)


def test_a_variant_has_one_pose_for_each_image(filmed: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    make_variant.write(str(filmed), out, make_variant.Variant(ways=2), filmed / "groundtruth.txt")
    for name in ("groundtruth.txt", "reference.tum"):
        made = read_tum(out / name)
        assert len(np.unique(made.stamps)) == len(made) == 17
        assert made.poses[:9] == pytest.approx(expected(9), abs=1e-5)
        assert made.poses[9:] == pytest.approx(expected(8)[::-1], abs=1e-5)


def test_places_are_measured_with_the_pose_of_each_image(filmed: Path) -> None:
    network = SimpleNamespace(raw=lambda rgb: [SimpleNamespace(descriptor=np.ones(4, np.float32))])
    indices, poses, _, silent = measure_places.describe(str(filmed), network, 2)  # type: ignore[arg-type]
    assert indices.tolist() == [0, 2, 4, 6, 8]
    assert silent == 0
    assert poses == pytest.approx(expected(9)[::2], abs=1e-5)


def test_the_gate_is_fitted_with_the_pose_of_each_image(filmed: Path) -> None:
    answer = SimpleNamespace(
        valid=True, depth=np.ones((48, 64), np.float32), image_to_depth=np.array([1.0, 0.0, 1.0, 0.0]),
        confidence=np.zeros((0, 0), np.float32),
    )  # fmt: skip
    network: Any = SimpleNamespace(infer=lambda rgb, camera: answer, counters={})
    made = fit_gate.keyframes(filmed, network, 2, None)
    assert [view.world_from_camera for view, _ in made] == pytest.approx(expected(9)[::2], abs=1e-5)


def test_a_cloud_is_brought_over_by_the_pose_of_each_keyframe() -> None:
    keyframes = [(round(k * NS / 30), pose(k / 30)) for k in range(1, 50, 4)]
    guess, scale = measure_cloud.first_guess(keyframes, captured(100.0, begin_s=0.0023), True)
    assert scale == pytest.approx(1.0, abs=1e-5)
    assert guess == pytest.approx(np.eye(4), abs=1e-5)


def test_frames_whose_descriptor_says_nothing_are_left_out_and_counted(filmed: Path, monkeypatch, capsys):
    said = [np.ones(4, np.float32), np.zeros(4, np.float32), np.zeros(0, np.float32)]
    said += [np.full(4, np.nan, np.float32), np.arange(4, dtype=np.float32)]
    answers = iter(2 * said)
    card = SimpleNamespace(descriptor_layer="")
    network: Any = SimpleNamespace(card=card, name="net")
    network.raw = lambda rgb: [SimpleNamespace(descriptor=next(answers))]
    indices, poses, descriptors, silent = measure_places.describe(str(filmed), network, 2)
    assert (indices.tolist(), silent) == ([0, 8], 3)
    assert poses == pytest.approx(expected(9)[[0, 8]], abs=1e-5)
    assert descriptors.shape == (2, 4)
    monkeypatch.setattr(measure_places, "open_onnx", lambda *_: network)
    monkeypatch.setattr(measure_places, "APART", 4)
    monkeypatch.setattr(measure_places, "OTHER_M", -1.0)  # so that there is something to score
    monkeypatch.setattr(measure_places, "SAME_M", 1e3)
    monkeypatch.setattr(measure_places, "SAME_DEG", 181.0)
    assert measure_places.main([str(filmed), "--model", "net", "--every", "2"]) == 0
    assert "left out: 3 frames" in capsys.readouterr().out


def test_a_recording_without_truth_has_none(tmp_path: Path) -> None:
    folder = write_sequence(tmp_path / "in", frames=2, width=64, height=48)
    (folder / "groundtruth.txt").unlink()
    assert len(own_truth(str(folder))) == 0
