"""Walks that the bundled network learns from."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from prism_edge.geometry.poses import from_rt
from prism_edge.sources.sim import SimSource
from tools.train_nano import walks
from tools.train_nano.pictures import Views
from tools.train_nano.walks import pairs, render, render_walk


def there_and_back(count: int) -> np.ndarray:
    """Poses (2 count, 4, 4) along a line, a decimetre a step, out and back again, looking one way."""
    along = np.concatenate([np.arange(count), np.arange(count)[::-1]]) * 0.1
    return np.array([from_rt(np.eye(3), np.array([x, 0.0, 0.0])) for x in along])


def test_frames_of_a_pair_are_near_apart_in_time_and_mostly_of_two_visits() -> None:
    poses = there_and_back(100)
    chosen = pairs(poses, 80, np.random.default_rng(0))
    first, second = chosen[::2], chosen[1::2]
    assert np.array_equal(chosen, pairs(poses, 80, np.random.default_rng(0)))
    assert len(set(first.tolist())) == 80
    assert np.all(np.abs(poses[first, 0, 3] - poses[second, 0, 3]) < 1.2)
    assert np.all(np.abs(first - second) >= 3)
    assert np.mean(np.abs(first - second) >= 30) > 0.6


def test_a_view_the_other_way_is_no_partner_and_a_lonely_frame_takes_a_neighbour() -> None:
    turned = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    poses = there_and_back(40)
    poses[40:, :3, :3] = turned
    poses[:, 0, 3] *= 5  # half a metre a step: nobody apart in time is near and looks the same way
    chosen = pairs(poses, 60, np.random.default_rng(1))
    assert set(np.abs(chosen[::2] - chosen[1::2]).tolist()) == {3}


def test_a_walks_views_are_the_sources_own_frames(tmp_path: Path) -> None:
    images = np.zeros((4, 240, 320, 3), np.uint8)
    depths = np.zeros((4, 120, 160), np.float16)
    poses, focal = render_walk(False, 2_500_321, images, depths)
    assert 220 <= focal <= 280
    ways = [SimSource(f"sim:room?seed=2500321&frames=6000&path={way}") for way in ("wheeled", "handheld")]
    known = [way.pose(frame) for way in ways for frame in range(0, 6000, 10)]
    for pose, image, depth in zip(poses, images, depths, strict=True):
        assert np.min([np.abs(pose - other).max() for other in known]) < 1e-9
        assert image.std() > 5
        assert 0.1 < np.median(depth.astype(float)) < 12


def test_closeness_is_overlap_lessened_by_distance(tmp_path: Path) -> None:
    render(tmp_path, rooms=1, loops=0, first=2_500_322)
    views = Views(tmp_path)
    rows = np.arange(0, 12)
    shared, close = views.shared(rows), views.close(rows)
    with np.load(tmp_path / "views.npz") as file:
        position = file["pose"][:12, :3, 3]
    for i in range(12):
        for j in range(12):
            metres = np.linalg.norm(position[i] - position[j])
            assert close[i, j] == pytest.approx(shared[i, j] * np.exp(-(metres**2) / 2), abs=1e-6)
    assert np.median(shared[np.arange(0, 12, 2), np.arange(1, 12, 2)]) > 0.3


def test_too_few_worlds_for_a_batch_are_an_error_and_no_endless_search(tmp_path: Path) -> None:
    count = 3 * 40
    np.save(tmp_path / "images.npy", np.zeros((count, 24, 32, 3), np.uint8))
    np.save(tmp_path / "depth.npy", np.ones((count, 12, 16), np.float16))
    views = {"world": np.repeat([1, 2, 3], 40), "focal": np.full(count, 20.0)}
    poses = np.tile(np.eye(4), (count, 1, 1))
    np.savez(tmp_path / "views.npz", overlap=np.zeros((count, 40), np.float16), pose=poses, **views)
    with pytest.raises(ValueError, match="takes 4 worlds or more, here are 3"):
        Views(tmp_path).check_worlds()
    with pytest.raises(ValueError, match="here are 3"):
        Views(tmp_path).batch(16, 12, 0.85, 1, 5, 1)


@pytest.mark.parametrize("more", [["--rooms=0", "--loops=0"], ["--rooms=-1"], ["--loops=few"]])
def test_no_walks_at_all_are_refused(more: list[str], tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.setattr("sys.argv", ["walks", str(tmp_path), *more])
    with pytest.raises(SystemExit) as ended:
        walks.main()
    assert ended.value.code == 2
    assert "--loops" in capsys.readouterr().err
