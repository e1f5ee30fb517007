"""TUM files against evo's reader, bad lines, and pairing by time against evo's synchronisation."""

from __future__ import annotations

import contextlib
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from evo.core import sync
from evo.core.trajectory import PoseTrajectory3D
from evo.tools import file_interface
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from prism_edge.errors import EvaluationError
from prism_edge.evaluation.trajectory import (
    NS,
    Trajectory,
    associate,
    paired,
    path_length,
    read_tum,
    rows_apart,
    tum_line,
    write_tum,
)


def random_trajectory(stamps_ns: np.ndarray, seed: int = 0) -> Trajectory:
    rng = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (len(stamps_ns), 1, 1))
    poses[:, :3, :3] = Rotation.random(len(stamps_ns), rng=rng).as_matrix()
    poses[:, :3, 3] = rng.normal(size=(len(stamps_ns), 3)) * 5
    return Trajectory(stamps_ns.astype(np.int64), poses)


def test_written_files_mean_the_same_to_evo(tmp_path: Path) -> None:
    ours = random_trajectory(1_700_000_000 * NS + np.arange(40) * 33_333_333)
    write_tum(tmp_path / "a.tum", ours)
    theirs = file_interface.read_tum_trajectory_file(tmp_path / "a.tum")
    np.testing.assert_allclose(np.array(theirs.poses_se3), ours.poses, atol=2e-8)
    np.testing.assert_allclose(theirs.timestamps, ours.stamps / NS, atol=1e-6)


def test_files_written_by_evo_are_read(tmp_path: Path) -> None:
    ours = random_trajectory(np.arange(40) * 100_000_000)
    theirs = PoseTrajectory3D(poses_se3=list(ours.poses), timestamps=ours.stamps / NS)
    file_interface.write_tum_trajectory_file(tmp_path / "b.tum", theirs)
    back = read_tum(tmp_path / "b.tum")
    np.testing.assert_array_equal(back.stamps, ours.stamps)
    np.testing.assert_allclose(back.poses, ours.poses, atol=1e-12)


@settings(max_examples=20, deadline=None)
@given(st.lists(st.integers(-(10**18), 4 * 10**18), min_size=1, max_size=8))
def test_stamps_survive_to_the_nanosecond(stamps: list[int]) -> None:
    ours = random_trajectory(np.array(sorted(stamps)))
    with TemporaryDirectory() as folder:
        write_tum(Path(folder) / "c.tum", ours)
        back = read_tum(Path(folder) / "c.tum")
    np.testing.assert_array_equal(back.stamps, ours.stamps)
    np.testing.assert_allclose(back.poses, ours.poses, atol=1e-8)


def test_the_mark_of_windows_editors_is_read_over(tmp_path: Path) -> None:
    (tmp_path / "a.tum").write_bytes(b"\xef\xbb\xbf1 2 3 4 0 0 0 1\r\n")
    assert read_tum(tmp_path / "a.tum").stamps.tolist() == [1_000_000_000]


def test_comments_blank_lines_and_disorder_are_fine(tmp_path: Path) -> None:
    file = tmp_path / "d.tum"
    file.write_text("# truth\n\n2.5 1 2 3 0 0 0 1.01 # rounded\n1e0 0 0 0 0 0 0 1\n")
    back = read_tum(file)
    assert back.stamps.tolist() == [NS, 5 * NS // 2]
    np.testing.assert_array_equal(back.poses[1, :3, :3], np.eye(3))


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ("1 2 3", "3 fields"),
        ("0 0 0 0 0 0 0 1 9", "9 fields"),
        ("x 0 0 0 0 0 0 1", "no time"),
        ("0 0 0 zero 0 0 0 1", "not a number"),
        ("inf 0 0 0 0 0 0 1", "no time"),
        ("1e30 0 0 0 0 0 0 1", "milliseconds"),
        ("1305031102175 0 0 0 0 0 0 1", "milliseconds"),
        ("0 0 0 0 0 0 0 0", "quaternion"),
    ],
)
def test_bad_lines_are_named(tmp_path: Path, line: str, reason: str) -> None:
    file = tmp_path / "bad.tum"
    file.write_text(f"0 0 0 0 0 0 0 1\n{line}\n")
    with pytest.raises(EvaluationError, match=rf"bad\.tum line 2: .*{reason}"):
        read_tum(file)


@settings(max_examples=30, deadline=None)
@given(st.text(max_size=60))
def test_any_text_is_read_or_refused(text: str) -> None:
    with TemporaryDirectory() as folder:
        file = Path(folder) / "any.tum"
        file.write_bytes(text.encode("utf-8", "surrogatepass"))
        with contextlib.suppress(EvaluationError):
            assert len(read_tum(file)) > 0


def test_files_that_are_none_are_refused(tmp_path: Path) -> None:
    (tmp_path / "empty.tum").write_text("# nothing\n")
    (tmp_path / "binary.tum").write_bytes(b"\xff\xfe\x00\x80")
    for name in ("empty.tum", "binary.tum", "absent.tum", "."):
        with pytest.raises(EvaluationError):
            read_tum(tmp_path / name)
    with pytest.raises(OSError, match="No such file or directory"):
        write_tum(tmp_path / "absent" / "x.tum", random_trajectory(np.arange(2)))


def test_negative_stamps_are_written_as_such() -> None:
    assert tum_line(-1_500_000_000, np.eye(4)).startswith("-1.500000000 0.000000000 ")


def test_a_trajectory_goes_forward() -> None:
    with pytest.raises(ValueError, match="backwards"):
        random_trajectory(np.array([2, 1]))
    with pytest.raises(ValueError, match="don't go with"):
        Trajectory(np.arange(3), np.tile(np.eye(4), (2, 1, 1)))
    assert len(Trajectory.of([])) == 0


MILLISECONDS = st.lists(st.integers(0, 2000), min_size=1, max_size=25, unique=True).map(
    lambda values: np.array(sorted(values))
)


@settings(max_examples=80, deadline=None)
@given(MILLISECONDS, MILLISECONDS)
@example(np.array([0, 1]), np.array([0, 11]))  # equally long
@example(np.array([0, 1]), np.array([0, 2]))
def test_pairs_are_evos(first_ms: np.ndarray, second_ms: np.ndarray) -> None:
    # an offset of 0.3 ms keeps differences off the tolerance and off ties, where rounding of floats decides
    first = random_trajectory(first_ms * 1_000_000)
    second = random_trajectory(second_ms * 1_000_000 + 300_000)
    ours = associate(first, second)
    as_evo = [PoseTrajectory3D(poses_se3=list(t.poses), timestamps=t.stamps / NS) for t in (first, second)]
    try:
        theirs = sync.associate_trajectories(*as_evo, max_diff=0.01)
    except sync.SyncException:
        assert len(ours[0]) == len(ours[1]) == 0
        return
    for mine, his in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(mine.stamps / NS, his.timestamps, atol=1e-9)


def test_dense_truth_of_a_part_of_the_run_counts_each_pose_once() -> None:
    """120 Hz in the first 1.5 of ten seconds at 20 Hz: fewer true poses than frames, so truth leads."""
    frames = random_trajectory(np.arange(200) * NS // 20)
    truth = random_trajectory(np.arange(178) * NS // 120 + 1_000_000)
    assert len(associate(frames, truth)[0]) > 60
    mine, his = paired(frames, truth)
    assert mine.stamps.tolist() == frames.stamps[:30].tolist()
    assert (his.stamps - mine.stamps).tolist() == [1_000_000] * 30
    within = paired(frames.at(np.arange(30)), truth)  # the same frames, when truth doesn't lead
    assert within[1].stamps.tolist() == his.stamps.tolist()


@settings(max_examples=40, deadline=None)
@given(MILLISECONDS, MILLISECONDS)
def test_pairs_are_evos_but_for_those_that_share_a_frame(first_ms: np.ndarray, second_ms: np.ndarray) -> None:
    frames = random_trajectory(first_ms * 1_000_000)
    truth = random_trajectory(second_ms * 1_000_000 + 300_000)
    beside = (truth.stamps >= frames.stamps[0] - 10**7) & (truth.stamps <= frames.stamps[-1] + 10**7)
    evos = list(zip(*(t.stamps.tolist() for t in associate(frames, truth.at(beside))), strict=True))
    ours = list(zip(*(t.stamps.tolist() for t in paired(frames, truth)), strict=True))
    assert set(ours) <= set(evos)
    assert [mine for mine, _ in ours] == sorted({mine for mine, _ in evos})
    for mine, his in ours:
        assert abs(his - mine) == min(abs(t - s) for s, t in evos if s == mine)


@pytest.mark.parametrize("count", [301, 3000])
def test_truth_that_goes_on_after_the_run_changes_no_pair(count: int) -> None:
    """A run of ten seconds at 120 Hz, and a tracker that gives 30 Hz, of the run or of far more."""
    frames = random_trajectory(np.arange(1201) * NS // 120)
    truth = random_trajectory(np.arange(count) * NS // 30 + 200_000)
    mine, his = paired(frames, truth)
    assert mine.stamps.tolist() == frames.stamps[::4].tolist()
    assert his.stamps.tolist() == truth.stamps[:301].tolist()


def test_rows_a_second_apart_are_found_where_stamps_come_twice() -> None:
    stamps = np.arange(31) * NS // 10 + np.random.default_rng(0).integers(0, 300_000, 31)
    starts, ends = rows_apart(np.repeat(stamps, 3), 1.0)
    assert set((starts // 3).tolist()) == set(range(21))
    assert (ends // 3 - starts // 3).tolist() == [10] * len(ends)
    for few in (np.zeros(5, np.int64), np.zeros(1, np.int64)):
        assert [len(rows) for rows in rows_apart(few, 1.0)] == [0, 0]


def test_nothing_pairs_with_nothing() -> None:
    some, none = random_trajectory(np.arange(3) * NS), Trajectory.of([])
    for first, second in ((some, none), (none, some)):
        assert [len(t) for t in associate(first, second)] == [0, 0]


def test_the_length_of_a_path_is_that_over_the_frames_alone() -> None:
    poses = np.tile(np.eye(4), (101, 1, 1))
    poses[:, 0, 3] = np.arange(101) * 0.1  # 1 m/s
    poses[1::2, 1, 3] = 0.05  # what a fast tracker adds, between the frames
    truth = Trajectory(np.arange(101) * NS // 10, poses)
    frames = np.arange(10, 91, 2) * NS // 10
    assert path_length(frames, truth) == pytest.approx(8.0)
    assert path_length(frames + NS // 20, truth) is None, "none has a true pose within 10 ms"
    assert path_length(frames[:1], truth) is None
    assert path_length(frames[:2], truth) == pytest.approx(0.2), "two poses are a way"
    assert path_length(frames[:0], truth) is None
    assert path_length(frames, truth.at(np.arange(0))) is None
