"""Both who read TUM poses, a recording's own truth and `--truth`, have one set of rules."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from sources import tiny_datasets as tiny

from prism_edge.errors import EvaluationError, PrismError, SourceError
from prism_edge.evaluation.trajectory import read_tum
from prism_edge.sources.truth import read_truth
from prism_edge.sources.tum_poses import read_poses

Stamped = tuple[list[int], np.ndarray]


def own(folder: Path) -> Stamped:
    """A recording's own truth."""
    truth = read_truth(str(folder))
    assert truth is not None
    return truth[0].tolist(), truth[1]


def named(folder: Path) -> Stamped:
    """The same file as `--truth FOLDER/groundtruth.txt` has it."""
    truth = read_tum(folder / "groundtruth.txt")
    return truth.stamps.tolist(), truth.poses


READERS = pytest.mark.parametrize(("read", "refusal"), [(own, SourceError), (named, EvaluationError)])


def with_truth(folder: Path, *lines: str) -> Path:
    folder = tiny.write_tum(folder)
    (folder / "groundtruth.txt").write_text("\n".join(lines) + "\n")
    return folder


@READERS
def test_poses_that_are_not_finite_are_left_out_with_one_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, read: Callable[[Path], Stamped], refusal: object
) -> None:
    """Motion capture that loses a body writes such lines."""
    lost = ("2 nan nan nan nan nan nan nan", "4 0 inf 0 0 0 0 1")
    folder = with_truth(tmp_path, "# truth", "1 1 0 0 0 0 0 1", lost[0], "3 3 0 0 0 0 0 1 # c", lost[1])
    stamps, poses = read(folder)
    assert stamps == [1_000_000_000, 3_000_000_000]
    np.testing.assert_array_equal(poses[:, 0, 3], [1, 3])
    (record,) = caplog.records
    file = folder / "groundtruth.txt"
    assert record.getMessage() == f"{file} line 3: not finite; 2 of 4 poses are such, and left out"


@READERS
@pytest.mark.parametrize("length", [0.91, 1.09])
def test_a_quaternion_of_few_digits_is_one_and_its_length_is_no_matter(
    tmp_path: Path, read: Callable[[Path], Stamped], refusal: object, length: float
) -> None:
    _, poses = read(with_truth(tmp_path, f"1 1 2 3 {length} 0 0 0"))
    np.testing.assert_allclose(poses[0], [[1, 0, 0, 1], [0, -1, 0, 2], [0, 0, -1, 3], [0, 0, 0, 1]])


@READERS
def test_stamps_are_kept_to_the_nanosecond(
    tmp_path: Path, read: Callable[[Path], Stamped], refusal: object
) -> None:
    stamps = ["-1.5e0", "1700000000.123456789", "9223372036.854775807"]
    folder = with_truth(tmp_path, *(f"{stamp} 0 0 0 0 0 0 1" for stamp in stamps))
    assert read(folder)[0] == [-1_500_000_000, 1_700_000_000_123_456_789, 2**63 - 1]


@READERS
@pytest.mark.parametrize(
    ("line", "why"),
    [
        ("2 0 0 0 0 0 1", "7 fields, but a pose has 8"),
        ("2 0 0 0 0 0 0 1 9", "9 fields, but a pose has 8"),
        ("2 0 0 zero 0 0 0 1", "not a number"),
        ("2 0 0 0 0 0 0 0.5", "the quaternion is not of length one"),
        ("2 0 0 0 0 0 0 2", "the quaternion is not of length one"),
        ("2 0 0 0 0 0 0 0", "the quaternion is not of length one"),
        ("2 0 0 0 0 0 0 1e308", "the quaternion is not of length one"),
        ("soon 0 0 0 0 0 0 1", "'soon' is no time in seconds"),
        ("nan 0 0 0 0 0 0 1", "'nan' is no time in seconds"),
        ("1305031102175 0 0 0 0 0 0 1", "nanoseconds or milliseconds"),
        ("9e999999 0 0 0 0 0 0 1", "nanoseconds or milliseconds"),
    ],
)
def test_a_line_that_is_no_pose_is_named(
    tmp_path: Path, read: Callable[[Path], Stamped], refusal: type[PrismError], line: str, why: str
) -> None:
    folder = with_truth(tmp_path, "1 0 0 0 0 0 0 1", line)
    with pytest.raises(refusal) as caught:
        read(folder)
    message = str(caught.value)
    assert message.startswith(f"{folder / 'groundtruth.txt'} line 2: ")
    assert why in message
    assert "\n" not in message


@READERS
def test_poses_none_of_which_is_finite_are_refused(
    tmp_path: Path, read: Callable[[Path], Stamped], refusal: type[PrismError]
) -> None:
    with pytest.raises(refusal, match="line 2: not finite, nor is any other"):
        read(with_truth(tmp_path, "# c", "1 nan 0 0 0 0 0 1", "2 0 0 0 inf 0 0 1"))


@READERS
def test_a_file_that_is_no_text_is_named(
    tmp_path: Path, read: Callable[[Path], Stamped], refusal: type[PrismError]
) -> None:
    folder = with_truth(tmp_path)
    (folder / "groundtruth.txt").write_bytes(b"\xff\xfe\x00\x80")
    with pytest.raises(refusal, match=r"groundtruth\.txt is no text file"):
        read(folder)


def test_a_file_that_can_not_be_read_is_named_with_the_reason(tmp_path: Path) -> None:
    for path, why in ((tmp_path / "gone.tum", "No such file"), (tmp_path, "Is a directory")):
        with pytest.raises(SourceError, match=why) as error:
            read_poses(path)
        assert str(path) in str(error.value)
