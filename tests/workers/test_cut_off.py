"""Whether a run goes on where an earlier one was cut off."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from prism_edge.backend.journal import Journal
from prism_edge.config import Config, SourceConfig, StateConfig
from prism_edge.workers.cut_off import (
    JOURNAL,
    MARK,
    MARK_BYTES,
    STAMP_S,
    TOLD,
    Moment,
    RunMark,
    goes_on,
    run_mark,
)

LIVE = "http://127.0.0.1:9/video"
NOW = Moment("boot-a", 5000.0, 1.7e9)


def later(seconds: float, wall_s: float | None = None, boot: str = "boot-a") -> Moment:
    return Moment(boot, NOW.boot_s + seconds, NOW.wall_s + (seconds if wall_s is None else wall_s))


def test_a_run_that_did_not_end_is_gone_on_from(tmp_path: Path) -> None:
    assert not RunMark(tmp_path).begin(600.0, NOW), "there was none before"
    assert RunMark(tmp_path).begin(600.0, later(20.0))


@pytest.mark.parametrize("seconds", [5000.06, 5000.0999999, 1 / 3])
def test_however_soon_after(tmp_path: Path, seconds: float) -> None:
    at = Moment("boot-a", seconds, 1.7e9 + seconds)
    RunMark(tmp_path).begin(600.0, at)
    assert RunMark(tmp_path).begin(600.0, at)


def test_a_run_that_ended_is_not(tmp_path: Path) -> None:
    mark = RunMark(tmp_path)
    mark.begin(600.0, NOW)
    mark.end()
    assert os.listdir(tmp_path) == []
    assert not RunMark(tmp_path).begin(600.0, later(20.0))


@pytest.mark.parametrize("ended", [True, False])
def test_what_a_run_does_not_go_on_in_is_no_later_run_s_either(tmp_path: Path, ended: bool) -> None:
    """One that is killed before its backend has begun would hand on the map of the run before it."""
    earlier = RunMark(tmp_path)
    earlier.begin(600.0, NOW)
    left = Journal(tmp_path)
    left.begin(lambda generation: b"a map")
    left.close()
    assert sorted(os.listdir(tmp_path)) == sorted([MARK, *JOURNAL])
    if ended:
        earlier.end()
    assert RunMark(tmp_path).begin(600.0, later(601.0)) is False
    assert os.listdir(tmp_path) == [MARK]


def test_what_a_run_goes_on_in_stays(tmp_path: Path) -> None:
    RunMark(tmp_path).begin(600.0, NOW)
    left = Journal(tmp_path)
    left.begin(lambda generation: b"a map")
    left.close()
    assert RunMark(tmp_path).begin(600.0, later(20.0))
    assert sorted(os.listdir(tmp_path)) == sorted([MARK, *JOURNAL])


@pytest.mark.parametrize(
    ("at", "expected"),
    [
        (later(599.0), True),
        (later(601.0), False),
        (later(20.0, wall_s=3620.0), True),  # a clock that was set within one start of the computer
        (later(20.0, wall_s=-3580.0), True),
        (later(-4900.0, wall_s=60.0, boot="boot-b"), True),  # a power cut: the wall clock has to do
        (later(-4900.0, wall_s=601.0, boot="boot-b"), False),
        (later(-4900.0, wall_s=-60.0, boot="boot-b"), False),  # a computer without a clock of its own
        (later(20.0, boot=""), True),
    ],
)
def test_how_long_ago_it_may_be(tmp_path: Path, at: Moment, expected: bool) -> None:
    RunMark(tmp_path).begin(600.0, NOW)
    assert RunMark(tmp_path).begin(600.0, at) is expected


def test_a_map_in_which_a_process_keeps_dying_is_taken_up_once(tmp_path: Path) -> None:
    first = RunMark(tmp_path)
    first.begin(600.0, NOW)
    first.gave_up()  # in a map of its own: it need not be the map's fault
    second = RunMark(tmp_path)
    assert second.begin(600.0, later(10.0))
    second.gave_up()
    assert not RunMark(tmp_path).begin(600.0, later(20.0))


def test_a_run_that_could_not_start_is_none_to_go_on_from(tmp_path: Path) -> None:
    refused = RunMark(tmp_path)
    refused.begin(600.0, NOW)
    refused.refused()
    assert not RunMark(tmp_path).begin(600.0, later(10.0))


def test_nor_does_it_come_between_a_run_that_was_cut_off_and_the_next(tmp_path: Path) -> None:
    RunMark(tmp_path).begin(600.0, NOW)
    for seconds in (300.0, 599.0):
        refused = RunMark(tmp_path)
        assert refused.begin(600.0, later(seconds))
        refused.refused()
    assert not RunMark(tmp_path).begin(600.0, later(601.0)), "it is no longer ago for that"


def test_it_says_now_and_then_that_it_lives(tmp_path: Path) -> None:
    mark, real = RunMark(tmp_path), Moment.now()
    mark.begin(600.0, replace(real, boot_s=real.boot_s - 1.01 * STAMP_S))
    before = (tmp_path / MARK).read_bytes()
    mark.alive()
    after = (tmp_path / MARK).read_bytes()
    assert before != after
    assert len(before) == len(after) == MARK_BYTES
    mark.alive()
    assert (tmp_path / MARK).read_bytes() == after, "not with each look"
    assert RunMark(tmp_path).begin(600.0)


@pytest.mark.parametrize("noise", [b"", b"\0" * 120, b"a b c d", b"x nan inf", b"x 1.0", b"\xff" * 500])
def test_a_mark_that_is_none_means_nothing(tmp_path: Path, noise: bytes) -> None:
    (tmp_path / MARK).write_bytes(noise)
    assert not RunMark(tmp_path).begin(600.0, NOW)
    assert RunMark(tmp_path).begin(600.0, later(1.0)), "and is one again"


def test_a_link_in_its_place_is_not_followed(tmp_path: Path) -> None:
    (tmp_path / "other").write_bytes(b"precious")
    (tmp_path / MARK).symlink_to(tmp_path / "other")
    assert not RunMark(tmp_path).begin(600.0, NOW)
    assert (tmp_path / "other").read_bytes() == b"precious"


def test_a_folder_that_can_not_be_costs_the_recovery_alone(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    mark = RunMark(tmp_path / "file" / "journal")
    assert not mark.begin(600.0, NOW)
    mark.alive()
    mark.end()


def test_only_live_cameras_in_real_time_with_a_folder_of_their_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("STATE_DIRECTORY", raising=False)
    state = StateConfig(directory=str(tmp_path))
    live = Config(source=SourceConfig(uri=LIVE), state=state)
    assert run_mark(live) is not None
    for other in (
        replace(live, source=SourceConfig(uri="sim:room")),
        replace(live, source=SourceConfig(uri=str(tmp_path), loop=True)),
        replace(live, mode="lockstep"),
        replace(live, state=StateConfig()),
        replace(live, state=replace(state, journal=False)),
        replace(live, state=replace(state, recover_s=0.0)),
    ):
        assert run_mark(other) is None
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path))
    assert run_mark(replace(live, state=StateConfig())) is not None
    for uri in ("v4l2:/dev/video0", "rtsp://127.0.0.1/x", "oak:"):
        assert run_mark(replace(live, source=SourceConfig(uri=uri))) is not None


def test_a_process_is_told_by_a_file_of_its_run(tmp_path: Path) -> None:
    assert not goes_on(SimpleNamespace(run_directory=None))  # type: ignore[arg-type]
    assert not goes_on(SimpleNamespace(run_directory=tmp_path))  # type: ignore[arg-type]
    (tmp_path / TOLD).touch()
    assert goes_on(SimpleNamespace(run_directory=tmp_path))  # type: ignore[arg-type]


def test_time_goes_by_the_wall_s_clock_where_nothing_tells_one_start_of_the_computer_from_another() -> None:
    assert Moment("", 7.0, 1900.0).since(Moment("", 5.0, 1000.0)) == 900.0
    assert Moment("a", 7.0, 1900.0).since(Moment("b", 5.0, 1000.0)) == 900.0
    assert Moment("a", 7.0, 900.0).since(Moment("a", 5.0, 1000.0)) == 2.0
