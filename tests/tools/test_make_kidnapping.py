"""The kidnapping recording: what is black, what is turned, and by how much."""

from __future__ import annotations

import sys

import cv2
import numpy as np
import pytest

from prism_edge.config import SourceConfig
from prism_edge.errors import SourceError
from prism_edge.evaluation.trajectory import read_tum
from prism_edge.geometry.cameras import Camera
from prism_edge.sources import open_source
from prism_edge.sources.truth import read_truth
from tests.synthetic.sequence import write_sequence
from tools import make_kidnapping


def test_a_turned_camera_sees_a_ray_where_it_should():
    camera = Camera(320, 240, 260.0, 250.0, 161.0, 118.0)
    ray = np.array([0.2, -0.15, 1.0])
    pixels = np.zeros((240, 320, 3), np.uint8)
    at = camera.project(ray[None])[0]
    cv2.circle(pixels, (round(at[0]), round(at[1])), 4, (255, 255, 255), -1)
    seen = make_kidnapping.turned(pixels, camera, 20.0)
    rows, columns = np.nonzero(seen[..., 0] > 128)
    expected = camera.project((make_kidnapping.roll_of(20.0)[:3, :3].T @ ray)[None])[0]
    assert (columns.mean(), rows.mean()) == pytest.approx(expected, abs=0.7)
    assert np.linalg.norm(expected - at) > 10
    assert np.array_equal(make_kidnapping.turned(pixels, camera, 0.0), pixels)


def test_a_recording_is_carried_off_and_comes_back(tmp_path):
    source = write_sequence(tmp_path / "in", frames=9, width=160, height=120)
    count = make_kidnapping.write(str(source), tmp_path / "out", (3, 6), 20.0, 8)
    assert count == 8
    out = tmp_path / "out"
    with open_source(SourceConfig(uri=str(out), camera=str(out / "camera.yaml"))) as made:
        images = [made.read().pixels for _ in range(8)]
    with open_source(SourceConfig(uri=str(source))) as original:
        first = original.read().pixels
        camera = original.camera
    assert made.camera == camera
    assert np.array_equal(images[0], first)
    assert [int(image.max()) == 0 for image in images] == [False] * 3 + [True] * 3 + [False] * 2
    stamps, poses = read_truth(str(tmp_path / "out"))
    _, before = read_truth(str(source))
    assert len(stamps) == 8
    assert poses[:, :3, 3] == pytest.approx(before[:8, :3, 3], abs=1e-6)
    assert poses[:6] == pytest.approx(before[:6], abs=1e-6)
    assert poses[6] == pytest.approx(before[6] @ make_kidnapping.roll_of(20.0), abs=1e-6)


def test_another_reference_is_turned_alike_and_has_nothing_of_the_dark(tmp_path):
    source = write_sequence(tmp_path / "in", frames=9, width=160, height=120)
    truth = tmp_path / "in" / "groundtruth.txt"
    out = tmp_path / "out"
    make_kidnapping.write(str(source), out, (3, 6), 20.0, 8, truth)
    made = read_tum(out / "reference.tum")
    stamps, poses = read_truth(str(out))
    lit = [0, 1, 2, 6, 7]
    assert made.stamps.tolist() == stamps[lit].tolist()
    assert made.poses == pytest.approx(poses[lit], abs=1e-6)


def test_an_unusable_recording_is_one_line(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["make_kidnapping", str(tmp_path / "nothing"), str(tmp_path / "out")])
    with pytest.raises(SystemExit) as ended:
        make_kidnapping.main()
    assert "nothing" in str(ended.value)
    assert "\n" not in str(ended.value)


def test_a_place_that_takes_no_folder_is_one_line(tmp_path, monkeypatch):
    source = write_sequence(tmp_path / "in", frames=2, width=160, height=120)
    (tmp_path / "file").touch()
    monkeypatch.setattr(sys, "argv", ["make_kidnapping.py", str(source), str(tmp_path / "file" / "out")])
    with pytest.raises(SystemExit, match="file") as ended:
        make_kidnapping.main()
    assert "\n" not in str(ended.value)


def test_a_folder_that_holds_something_is_refused_and_left_as_it_is(tmp_path):
    """Images of an earlier, longer recording would be played as well."""
    source, out = write_sequence(tmp_path / "in", frames=9, width=160, height=120), tmp_path / "out"
    make_kidnapping.write(str(source), out, (3, 6), 20.0, 8)
    before = sorted(out.rglob("*"))
    with pytest.raises(SourceError, match="not empty"):
        make_kidnapping.write(str(source), out, (3, 6), 20.0, 8)
    assert sorted(out.rglob("*")) == before
