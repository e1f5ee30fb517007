"""One process through its lives."""

from __future__ import annotations

import pytest

from prism_edge.config import SupervisorConfig
from prism_edge.errors import SupervisionError
from prism_edge.messages import Heartbeat
from prism_edge.processes import PROCESSES
from prism_edge.supervisor.health import ERROR, OK, STALE, WARN
from prism_edge.supervisor.liveness import ALIVE, OVERDUE
from prism_edge.supervisor.watch import StartRefusedError, Watch


def beat(pid: int, state: str, **values: str) -> Heartbeat:
    return Heartbeat("depth", pid, 0, state, "", 0, 60.0, values)


@pytest.fixture
def watch() -> Watch:
    watch = Watch(PROCESSES["depth"], SupervisorConfig(backoff_s=0.5, max_restarts=2, start_s=20.0))
    watch.started(100, 0.0)
    return watch


def test_ready_once_it_says_so(watch: Watch) -> None:
    assert not watch.ready
    watch.heard(beat(100, "starting"), 0.1)
    assert not watch.ready
    assert watch.row(0.2).level == WARN
    watch.heard(beat(100, "ready", provider="CPU"), 0.3)
    assert watch.ready
    row = watch.row(0.4)
    assert (row.level, row.values["pid"], row.values["provider"]) == (OK, "100", "CPU")


def test_heartbeat_of_a_previous_life_is_ignored(watch: Watch) -> None:
    watch.exited(1, 1.0)
    watch.started(101, 1.5)
    watch.heard(beat(100, "ready"), 1.6)
    assert watch.state == "starting"


def test_loss_and_restart_show_in_its_row(watch: Watch) -> None:
    watch.heard(beat(100, "idle"), 0.5)
    assert watch.exited(-9, 2.0) == "killed by SIGKILL"
    assert watch.restart_at_s == 2.5
    row = watch.row(2.1)
    assert (row.level, row.values["state"]) == (ERROR, "restarting")
    assert row.values["last_exit"] == "killed by SIGKILL"
    watch.started(101, 2.5)
    watch.heard(beat(101, "ready"), 3.0)
    row = watch.row(3.1)
    assert (row.level, row.values["restarts"], row.values["pid"]) == (OK, "1", "101")


def test_silence_shows_in_its_row(watch: Watch) -> None:
    watch.heard(beat(100, "idle"), 1.0)
    assert watch.row(4.0).level == STALE


@pytest.mark.parametrize("code", [3, 4, 5, 6])
def test_users_error_before_ready_ends_the_run_with_its_code(watch: Watch, code: int) -> None:
    with pytest.raises(StartRefusedError) as caught:
        watch.exited(code, 1.0)
    assert caught.value.exit_code == code


def test_same_code_after_it_was_ready_is_a_death_like_any_other(watch: Watch) -> None:
    watch.heard(beat(100, "ready"), 0.5)
    watch.exited(5, 1.0)
    assert watch.restart_at_s == 1.5
    watch.started(101, 1.5)
    watch.exited(5, 2.0)
    assert watch.restart_at_s == 3.0


@pytest.mark.parametrize("code", [0, 1, 2, 70, -11])
def test_any_other_end_is_a_death(watch: Watch, code: int) -> None:
    watch.exited(code, 1.0)
    assert watch.restart_at_s == 1.5


def test_dying_too_often_gives_up_naming_process_and_exit(watch: Watch) -> None:
    watch.exited(1, 1.0)
    watch.exited(1, 2.0)
    with pytest.raises(SupervisionError, match=r"depth died more than 2 times.*exit code 70"):
        watch.exited(70, 3.0)


def test_never_getting_ready_is_a_hang(watch: Watch) -> None:
    assert watch.verdict(19.0).liveness != OVERDUE
    verdict = watch.verdict(21.0)
    assert verdict.liveness == OVERDUE
    watch.killed(verdict.why)
    assert "not ready after 20 s" in watch.exited(-9, 21.1)


def test_an_end_is_put_down_to_a_hang_of_that_life_alone(watch: Watch) -> None:
    watch.killed("not ready after 20 s")
    assert watch.is_being_killed
    watch.exited(-9, 21.0)
    assert not watch.is_being_killed
    watch.started(101, 21.5)
    assert watch.exited(1, 22.0) == "exit code 1"


def test_other_limits_hold_for_deaths_too(watch: Watch) -> None:
    watch.exited(1, 1.0)
    watch.configure(SupervisorConfig(backoff_s=0.5, max_restarts=1))
    watch.started(101, 1.5)
    with pytest.raises(SupervisionError, match="depth died more than 1 times"):
        watch.exited(1, 2.0)


def declared(activity: str, since_s: float, now_s: float, budget_s: float) -> Heartbeat:
    return Heartbeat("depth", 100, int(now_s * 1e9), "starting", activity, int(since_s * 1e9), budget_s, {})


def test_declared_work_has_its_budget_though_the_start_takes_longer_by_it(watch: Watch) -> None:
    watch.heard(declared("loading the network", 2.0, 3.0, 120.0), 3.0)
    assert watch.verdict(121.9).liveness == ALIVE
    verdict = watch.verdict(122.5)
    assert (verdict.liveness, "loading the network has taken" in verdict.why) == (OVERDUE, True)


def test_where_starts_may_take_longer_than_usual_so_may_each_work_of_one() -> None:
    """A network that takes four minutes to load from a slow disk."""
    watch = Watch(PROCESSES["depth"], SupervisorConfig(start_s=300.0))
    watch.started(100, 0.0)
    watch.heard(declared("", 0.0, 0.5, 60.0), 0.5)
    assert watch.verdict(299.0).liveness == ALIVE
    watch.heard(declared("loading the network", 200.0, 201.0, 120.0), 201.0)
    assert watch.verdict(299.0).liveness == ALIVE
    assert watch.verdict(321.0).liveness == OVERDUE, "more than 300 s in all, and than the work may take"


def test_what_follows_declared_work_has_its_own_budget(watch: Watch) -> None:
    watch.heard(declared("estimating the camera", 2.0, 3.0, 180.0), 3.0)
    watch.heard(declared("opening the source", 170.0, 170.5, 60.0), 170.5)
    assert watch.verdict(229.0).liveness == ALIVE
    assert watch.verdict(230.5).liveness == OVERDUE


def test_a_start_that_declares_nothing_more_is_held_to_what_was_granted(watch: Watch) -> None:
    watch.heard(declared("opening the source", 2.0, 3.0, 10.0), 3.0)
    watch.heard(declared("", 12.0, 12.5, 60.0), 12.5)
    assert watch.verdict(19.0).liveness == ALIVE
    assert "not ready after 20 s" in watch.verdict(21.0).why


def test_one_that_was_ready_and_starts_again_comes_back_while_it_is_heard_of_in_time(watch: Watch) -> None:
    watch.heard(beat(100, "starting"), 0.1)
    assert not watch.comes_back(0.2), "never ready yet"
    watch.heard(beat(100, "idle"), 0.5)
    watch.exited(-9, 2.0)
    assert not watch.comes_back(2.1), "down"
    watch.started(101, 2.5)
    assert not watch.comes_back(2.6), "not heard of yet"
    watch.heard(beat(101, "starting"), 3.0)
    assert watch.comes_back(22.0)
    assert not watch.healthy(22.0), "no pose can flow meanwhile"
    assert not watch.comes_back(23.0), "it may take 20 s"
    watch.heard(beat(101, "ready"), 23.5)
    assert watch.healthy(23.6)


def starts_in_vain(watch: Watch, pid: int, hangs: bool) -> bool:
    """A start that hangs until it is killed, or ends by itself; whether it was taken for one that comes back.

    Far enough from the one before for deaths to be forgotten.
    """
    now_s = 1000.0 * pid
    watch.started(pid, now_s)
    watch.heard(beat(pid, "starting"), now_s + 1.0)
    came_back = watch.comes_back(now_s + 2.0)
    if hangs:
        watch.killed(watch.verdict(now_s + 21.0).why)
    watch.exited(-9 if hangs else 4, now_s + 21.0)
    return came_back


def test_one_that_hangs_in_every_start_does_not_come_back_for_ever(watch: Watch) -> None:
    watch.configure(SupervisorConfig(backoff_s=0.5, max_restarts=9, start_s=20.0))
    for pid in (100, 110):  # what counts is the starts since it was last ready
        watch.started(pid, 1000.0 * pid)
        watch.heard(beat(pid, "ready"), 1000.0 * pid + 0.5)
        watch.exited(-9, 1000.0 * pid + 1.0)
        assert [starts_in_vain(watch, pid + i, hangs=True) for i in range(1, 6)] == [True] * 3 + [False] * 2


def test_one_that_hangs_in_every_start_is_given_up_however_long_they_take(watch: Watch) -> None:
    watch.heard(beat(100, "ready"), 0.5)
    watch.exited(-9, 1.0)
    for pid in (101, 102):
        starts_in_vain(watch, pid, hangs=True)
    with pytest.raises(SupervisionError, match=r"depth hung in 3 starts in a row.*not ready after 20 s"):
        starts_in_vain(watch, 103, hangs=True)


def test_one_that_waits_for_its_camera_and_ends_by_itself_comes_back_each_time(watch: Watch) -> None:
    watch.heard(beat(100, "ready"), 0.5)
    watch.exited(4, 1.0)
    assert all(starts_in_vain(watch, pid, hangs=False) for pid in range(101, 111))


def test_a_warning_of_its_own_shows_in_its_row_while_it_stands(watch: Watch) -> None:
    watch.heard(beat(100, "idle", warning="no usable depth: all NaN"), 0.5)
    row = watch.row(0.6)
    assert (row.level, row.message) == (WARN, "no usable depth: all NaN")
    watch.heard(beat(100, "idle"), 1.0)
    assert watch.row(1.1).level == OK


def test_each_start_is_a_life_more(watch: Watch) -> None:
    assert watch.lives == 1
    watch.exited(-9, 1.0)
    watch.started(101, 1.5)
    assert (watch.lives, watch.restarts) == (2, 1)


def test_one_that_was_started_after_the_recording_had_ended_has_nothing_to_do(watch: Watch) -> None:
    watch.heard(beat(100, "idle"), 0.5)
    assert not watch.ended(None)
    assert not watch.ended(1.0)  # it is to say itself that it has done its work
    watch.exited(-9, 2.0)
    assert not watch.ended(1.0)
    watch.started(101, 2.5)
    assert not watch.ended(1.0)
    watch.heard(beat(101, "ready"), 3.0)
    assert watch.ended(1.0)
    assert not watch.ended(4.0)  # it was ready in time to hear of the end
    watch.heard(beat(101, "idle"), 5.0)
    assert not watch.ended(4.0)  # however often it says so


def test_a_start_that_fails_counts_as_a_death(watch: Watch) -> None:
    watch.exited(1, 1.0)
    watch.not_started("no process left", 1.5)
    assert watch.restart_at_s == 2.5
    with pytest.raises(SupervisionError, match=r"died more than 2 times.*no process left"):
        watch.not_started("no process left", 2.5)


def test_a_first_life_that_is_late_says_itself_when_it_has_ended(watch: Watch) -> None:
    """It has been linked since before the recording began, and hears of all of it once it is ready."""
    watch.heard(beat(100, "ready"), 3.0)
    assert not watch.ended(1.0)


def test_one_that_says_so_has_ended(watch: Watch) -> None:
    watch.heard(beat(100, "ended"), 0.5)
    assert watch.ended(None)


@pytest.fixture
def on_trial(watch: Watch) -> Watch:
    """Was ready, and has been started with another configuration at 3 s."""
    watch.heard(beat(100, "ready"), 0.5)
    watch.asked_to_end_s = 2.0
    watch.exited(0, 2.5)
    watch.started(101, 3.0)
    assert watch.is_unproven
    return watch


def test_one_on_trial_refuses_by_a_users_error(on_trial: Watch) -> None:
    assert on_trial.refuses(5)
    assert not on_trial.refuses(-9)


def test_a_trial_outlives_a_death_that_may_be_chance(on_trial: Watch) -> None:
    on_trial.exited(-9, 4.0)
    assert on_trial.is_unproven
    on_trial.started(102, 5.0)
    assert on_trial.is_unproven
    assert on_trial.refuses(5)
    assert on_trial.refuses(-9), "the second"


def test_a_trial_ends_once_it_is_ready(on_trial: Watch) -> None:
    on_trial.exited(-9, 4.0)
    on_trial.started(102, 5.0)
    on_trial.heard(beat(102, "ready"), 6.0)
    assert not on_trial.is_unproven
    assert not on_trial.refuses(5)


def test_each_configuration_has_a_trial_of_its_own(on_trial: Watch) -> None:
    on_trial.exited(-9, 4.0)
    on_trial.asked_to_end_s = 4.1
    assert not on_trial.refuses(5), "what it was started with is none any more"
    on_trial.started(102, 5.0)
    assert on_trial.is_unproven
    assert not on_trial.refuses(-9)
