"""Back-off and giving up, by the clock that the caller names."""

from __future__ import annotations

from hypothesis import given, settings
from hypothesis import strategies as st

from prism_edge.config import SupervisorConfig
from prism_edge.config_file import leaves
from prism_edge.supervisor.restart import LONGEST_PAUSE_S, RestartPolicy, least_s


def test_pause_doubles_with_each_death_in_the_window() -> None:
    policy = RestartPolicy(SupervisorConfig(backoff_s=0.25, max_restarts=4, window_s=60))
    assert [policy.died(t) for t in (0, 1, 2, 3)] == [0.25, 0.5, 1.0, 2.0]


def test_one_death_too_many_gives_up() -> None:
    policy = RestartPolicy(SupervisorConfig(max_restarts=2, window_s=60))
    assert [policy.died(t) is None for t in (0, 1, 2)] == [False, False, True]


def test_one_death_too_many_gives_up_on_a_host_that_has_long_been_up() -> None:
    policy = RestartPolicy(SupervisorConfig(max_restarts=2, window_s=60))
    assert [policy.died(1e6 + t) is None for t in (0, 1, 2)] == [False, False, True]


def test_other_limits_hold_from_the_next_death_on_and_past_deaths_count() -> None:
    policy = RestartPolicy(SupervisorConfig(backoff_s=0.25, max_restarts=9, window_s=60))
    assert [policy.died(t) for t in (0, 1)] == [0.25, 0.5]
    policy.configure(SupervisorConfig(backoff_s=1.0, max_restarts=3, window_s=60))
    assert [policy.died(t) for t in (2, 3)] == [4.0, None]


def test_deaths_older_than_the_window_are_forgotten() -> None:
    policy = RestartPolicy(SupervisorConfig(backoff_s=0.5, max_restarts=2, window_s=10))
    assert [policy.died(t) for t in (0, 1, 12, 23)] == [0.5, 1.0, 0.5, 0.5]


def test_no_restarts_allowed_gives_up_at_the_first_death() -> None:
    assert RestartPolicy(SupervisorConfig(max_restarts=0)).died(5.0) is None


@given(st.lists(st.floats(0, 100), min_size=1, max_size=80), st.integers(0, 1000), st.floats(0, 60))
@settings(max_examples=60, deadline=None)
def test_gives_up_exactly_when_the_window_holds_more_than_allowed(
    gaps: list[float], allowed: int, backoff: float
) -> None:
    policy = RestartPolicy(SupervisorConfig(max_restarts=allowed, window_s=50.0, backoff_s=backoff))
    now, deaths = 0.0, []
    for gap in gaps:
        now += gap
        deaths.append(now)
        pause = policy.died(now)
        assert (pause is None) == (sum(now - t <= 50.0 for t in deaths) > allowed)
        assert pause is None or 0 <= pause <= LONGEST_PAUSE_S


def test_restarts_that_do_not_fit_into_the_window_go_on_for_ever() -> None:
    for config, most in ((SupervisorConfig(), 5), (SupervisorConfig(max_restarts=12), None)):
        policy, now_s, restarts = RestartPolicy(config), 0.0, 0
        while restarts < 100 and (pause := policy.died(now_s)) is not None:
            now_s, restarts = now_s + pause, restarts + 1
        assert restarts == (100 if most is None else most)
        assert (least_s(config) > config.window_s) is (most is None)


def test_a_first_pause_may_be_no_longer_than_the_longest() -> None:
    (backoff,) = (leaf for leaf in leaves() if leaf.key == "supervisor.backoff_s")
    assert backoff.high == LONGEST_PAUSE_S
