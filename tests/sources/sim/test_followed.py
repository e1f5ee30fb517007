"""A camera that follows a file: its poses as they stand, a room that is large enough, bad files refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from prism_edge.errors import SourceError
from prism_edge.geometry.poses import Array, from_rt, inverse, quaternion_from_rotation, so3_exp
from prism_edge.sources.sim import SimSource
from prism_edge.sources.sim.followed import CLEAR, EYE_LEVEL, Followed
from prism_edge.sources.sim.paths import looking

TINY = "width=80&height=60"


def a_way(count: int = 40, wide: float = 1.0, high: float = 0.2, seed: int = 0) -> list[tuple[float, Array]]:
    """Seconds and poses of a camera that goes to and fro and looks about, at irregular times."""
    rng = np.random.default_rng(seed)
    seconds = 1700.5 + np.cumsum(rng.uniform(0.05, 0.2, count))
    places = rng.uniform(-0.5, 0.5, (count, 3)) * (wide, wide, high)
    places[:2] = np.array([[-wide, -wide, -high], [wide, wide, high]]) / 2
    turns = rng.uniform(-3.0, 3.0), rng.uniform(-0.5, 0.5)
    poses = [looking(place, turns[0] + 0.2 * k, turns[1], 0.1) for k, place in enumerate(places)]
    return list(zip(seconds.tolist(), poses, strict=True))


def written(path: Path, way: list[tuple[float, Array]]) -> Path:
    lines = []
    for seconds, pose in way:
        numbers = [*pose[:3, 3], *quaternion_from_rotation(pose[:3, :3])]
        lines.append(f"{seconds:.9f} " + " ".join(f"{n:.9f}" for n in numbers))
    path.write_text("\n".join(lines) + "\n")
    return path


def test_it_is_where_the_file_says_when_it_says_so(tmp_path: Path) -> None:
    way = a_way()
    path = Followed(written(tmp_path / "way.tum", way))
    path.place(np.array([3.0, 2.0]))
    began, first = way[0]
    for seconds, pose in way:
        there = path.pose(seconds - began)
        assert inverse(path.pose(0.0)) @ there == pytest.approx(inverse(first) @ pose, abs=1e-6)
        assert there[:3, :3] == pytest.approx(pose[:3, :3], abs=1e-6)  # z of the file is up


def test_it_goes_straight_from_pose_to_pose_and_back_again(tmp_path: Path) -> None:
    turn = np.array([0.3, -0.2, 0.5])
    ends = [(0.0, np.eye(4)), (2.0, from_rt(so3_exp(turn), np.array([1.0, 0.5, -0.2])))]
    path = Followed(written(tmp_path / "way.tum", ends))
    path.place(np.zeros(2))
    start = path.pose(0.0)
    for seconds, share in ((0.5, 0.25), (1.5, 0.75), (2.0, 1.0), (2.5, 0.75), (4.0, 0.0), (5.0, 0.5)):
        moved = inverse(start) @ path.pose(seconds)
        assert moved[:3, 3] == pytest.approx(share * np.array([1.0, 0.5, -0.2]), abs=1e-8)
        assert moved[:3, :3] == pytest.approx(so3_exp(share * turn), abs=1e-8)


def test_speed_is_the_mean(tmp_path: Path) -> None:
    file = written(tmp_path / "way.tum", a_way())
    usual, fast = Followed(file), Followed(file, speed=0.8)
    times = np.linspace(0.0, fast.length_s, 4000)
    places = np.array([fast.pose(t)[:3, 3] for t in times])
    way = float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum())
    assert way / fast.length_s == pytest.approx(0.8, rel=0.01)
    assert fast.pose(0.3 * fast.length_s) == pytest.approx(usual.pose(0.3 * usual.length_s))


@pytest.mark.parametrize(("wide", "high"), [(0.3, 0.1), (5.0, 0.5), (9.0, 3.9)])
def test_the_room_is_large_enough(tmp_path: Path, wide: float, high: float) -> None:
    file = written(tmp_path / "way.tum", a_way(25, wide, high))
    for seed in (0, 1):
        source = SimSource(f"sim:room?seed={seed}&follow={file}&rate=5&{TINY}")
        room = source.plan.rooms[0]
        _, poses = source.truth()
        places = poses[:, :3, 3]
        assert (places[:, :2] > room.low + 1.0).all()
        assert (places[:, :2] < room.high - 1.0).all()
        assert places[:, 2].min() > CLEAR - 0.01
        assert places[:, 2].max() < room.height - CLEAR + 0.01
        if high < 1.0:
            assert (places[:, 2].min() + places[:, 2].max()) / 2 == pytest.approx(EYE_LEVEL, abs=0.1)
        with source:
            assert min(float(source.depth(k).min()) for k in range(source.frame_count)) > 0.2


def test_it_is_as_long_as_the_file_unless_frames_are_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    way = a_way()
    file = written(tmp_path / "way.tum", way)
    lasts = way[-1][0] - way[0][0]
    assert SimSource(f"sim:room?follow={file}&rate=20").frame_count == int(lasts * 20) + 1
    assert SimSource(f"sim:room?follow={file}&frames=7").frame_count == 7
    monkeypatch.setenv("HOME", str(tmp_path))
    assert SimSource("sim:room?follow=~/way.tum&frames=7").frame_count == 7
    assert "way.tum" in SimSource(f"sim:room?follow={file}").name


@pytest.mark.parametrize(
    ("poses", "names"),
    [
        ([], "two moments"),
        (a_way(1 + 1)[:1], "two moments"),
        ([(1.0, np.eye(4))] * 3, "two moments"),
        (a_way(wide=20.1), "20.1 m wide"),
        (a_way(high=4.1), "4.1 m high"),
    ],
)
def test_ways_that_can_not_be_followed(tmp_path: Path, poses: list[tuple[float, Array]], names: str) -> None:
    file = written(tmp_path / "way.tum", poses)
    with pytest.raises(SourceError, match=names) as caught:
        SimSource(f"sim:room?follow={file}")
    assert str(file) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_files_that_are_none(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="absent"):
        SimSource(f"sim:room?follow={tmp_path / 'absent.tum'}")
    (tmp_path / "words.tum").write_text("a way leads here\n")
    with pytest.raises(SourceError, match="line 1"):
        SimSource(f"sim:room?follow={tmp_path / 'words.tum'}")
    standing = written(tmp_path / "standing.tum", [(1.0, np.eye(4)), (2.0, np.eye(4))])
    assert SimSource(f"sim:room?follow={standing}").frame_count == 31
    with pytest.raises(SourceError, match="stands still"):
        SimSource(f"sim:room?follow={standing}&speed=0.5")
