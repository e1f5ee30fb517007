"""What the bundled network learns from: poses, overlap and metres of its pictures, without training it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from prism_edge.geometry.poses import from_rt
from prism_edge.sources.sim.floorplan import make_plan
from tools.train_nano import pictures
from tools.train_nano.parity import relative_difference
from tools.train_nano.pictures import Views, spoilt
from tools.train_nano.render import HEIGHT, HELD_OUT_SEED, WIDTH, overlaps, pair, render
from tools.train_nano.ruler import CANONICAL_FOCAL


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One rendered world of one room."""
    out = tmp_path_factory.mktemp("rendered")
    render(out, rooms=1, loops=0, worlds=0, first=HELD_OUT_SEED + 77)
    return out


def test_worlds_come_out_the_same_again(folder: Path, tmp_path: Path) -> None:
    render(tmp_path, rooms=3, loops=0, worlds=1, first=HELD_OUT_SEED + 77)
    for name in ("images.npy", "depth.npy"):
        assert np.array_equal(np.load(folder / name), np.load(tmp_path / name))


def test_views_of_a_pair_show_one_place_from_free_ground() -> None:
    plan, rng = make_plan(False, 5), np.random.default_rng(0)
    for _ in range(20):
        first, second = pair(plan, rng)
        for pose in (first, second):
            assert np.all(pose[:2, 3] >= plan.zone[0] - 0.21)
            assert np.all(pose[:2, 3] <= plan.zone[1] + 0.21)
        assert np.linalg.norm(first[:3, 3] - second[:3, 3]) < 1.5


def wall(metres: float) -> np.ndarray:
    return np.full((HEIGHT // 2, WIDTH // 2), metres, np.float16)


def test_overlap_of_a_wall_seen_from_two_places_is_the_share_in_common() -> None:
    """A wall 2 m ahead, focal length 160: the picture spans 4 m, so a step of 1 m aside leaves 3 / 4."""
    aside = from_rt(np.eye(3), np.array([1.0, 0.0, 0.0]))
    shared = overlaps(np.stack([wall(2.0), wall(2.0)]), np.stack([np.eye(4), aside]), np.full(2, 160.0))
    assert np.diag(shared) == pytest.approx([1.0, 1.0])
    assert shared[0, 1] == pytest.approx(0.75, abs=0.07)
    assert shared[1, 0] == pytest.approx(0.75, abs=0.07)


def test_what_is_hidden_is_not_seen_in_common() -> None:
    shared = overlaps(np.stack([wall(2.0), wall(1.0)]), np.stack([np.eye(4)] * 2), np.full(2, 160.0))
    assert shared[0, 1] == shared[1, 0] == 0.0


PARTS = [(0.0, 0.0, 320.0, 240.0), (60.0, 30.0, 200.0, 180.0), (10.0, 90.0, 240.0, 80.0)]


@pytest.mark.parametrize("part", PARTS)
@pytest.mark.parametrize("size", [(96, 80), (128, 96)])
def test_metres_follow_from_output_and_focal_length_of_any_part_at_any_size(folder: Path, part, size) -> None:
    """The contract's rule, metres = output * f / f0, f0 in proportion to the size, against stored depth."""
    views, row = Views(folder), 4
    x, y, w, h = part
    _, output = views._cut(row, part, *size)
    f = views.focal[row] * np.sqrt(size[0] / w * size[1] / h)
    f0 = CANONICAL_FOCAL * np.sqrt(size[0] * size[1] / (128 * 96))
    metres = output * f / f0
    stored = np.asarray(views.depths[row], np.float32)
    rows, columns = (np.arange(n) + 0.5 for n in output.shape)
    at_y = np.rint((y + rows * h / output.shape[0]) / 2 - 0.5).astype(int)
    at_x = np.rint((x + columns * w / output.shape[1]) / 2 - 0.5).astype(int)
    expected = stored[np.clip(at_y, 0, 119)[:, None], np.clip(at_x, 0, 159)[None]]
    agree = np.abs(metres / expected - 1) < 0.03
    assert agree.mean() > 0.97  # all but where rounding goes to the other side of an edge


def test_batches_hold_whole_pairs_and_are_the_same_again(folder: Path, monkeypatch) -> None:
    monkeypatch.setattr(pictures, "WORLDS", 1)
    views = Views(folder)
    first, again, other = (views.batch(96, 80, 0.55, 7, step) for step in (0, 0, 1))
    assert all(np.array_equal(a, b) for a, b in zip(first, again, strict=True))
    assert not np.array_equal(first.image, other.image)
    assert first.image.shape == (8, 3, 80, 96)
    assert first.depth.shape == (8, 40, 48)
    assert np.array_equal(first.overlap, first.overlap.T)
    assert np.median(first.overlap[np.arange(0, 8, 2), np.arange(1, 8, 2)]) > 0.4


def test_no_crop_is_narrower_than_asked_for(folder: Path, monkeypatch) -> None:
    monkeypatch.setattr(pictures, "WORLDS", 1)
    views, widths = Views(folder), []
    cut = views._cut

    def watched(row, part, *size):
        widths.append(part[2])
        return cut(row, part, *size)

    monkeypatch.setattr(views, "_cut", watched)
    for step in range(6):
        views.batch(96, 80, 0.9, 7, step)
    assert min(widths) >= 0.74 * 320  # the tallest aspect, once the picture's own height is used up
    widths.clear()
    for step in range(6):
        views.batch(96, 80, 0.4, 7, step)
    assert min(widths) < 0.6 * 320


def test_a_folder_without_views_is_said_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match="no rendered views"):
        Views(tmp_path)


def test_spoiling_keeps_a_picture_a_picture() -> None:
    rng = np.random.default_rng(1)
    clean = np.repeat(np.linspace(0, 255, 96, dtype=np.uint8)[None, :, None], 80, axis=0).repeat(3, axis=2)
    for _ in range(60):
        out = spoilt(clean, rng)
        assert out.shape == clean.shape
        assert out.dtype == np.uint8
        assert np.corrcoef(out.astype(float).mean(axis=(0, 2)), clean[0, :, 0].astype(float))[0, 1] > 0.4


def test_an_answer_that_is_not_finite_is_as_far_off_as_can_be() -> None:
    """max(0, nan) is 0 in Python: such a file was kept."""
    expected = np.array([[1.0, -4.0]], np.float32)
    assert relative_difference(expected, expected) == 0.0
    assert relative_difference(expected + np.float32(0.2), expected) == pytest.approx(0.05)
    for spoilt_value in (np.nan, np.inf):
        assert relative_difference(np.array([[1.0, spoilt_value]], np.float32), expected) == np.inf
        assert relative_difference(expected, np.array([[spoilt_value, 1.0]], np.float32)) == np.inf
    assert relative_difference(expected, np.zeros((1, 2), np.float32)) > 1.0
    assert relative_difference(np.zeros((1, 2), np.float32), np.zeros((1, 2), np.float32)) == 0.0


def test_training_can_not_stop_behind_its_last_step(tmp_path: Path, monkeypatch, capsys) -> None:
    pytest.importorskip("torch")
    from tools.train_nano import train

    monkeypatch.setattr("sys.argv", ["train", "data", str(tmp_path), "--steps", "5,7", "--stop", "8"])
    with pytest.raises(SystemExit):
        train.main()
    assert "--stop 8: the last stage has 7 steps" in capsys.readouterr().err
