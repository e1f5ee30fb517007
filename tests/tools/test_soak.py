"""What the long run says about the map's place, against motions that are known."""

from __future__ import annotations

import numpy as np
import pytest

from prism_edge.geometry.poses import Array, from_rt, so3_exp
from tools.faults_service import one_run
from tools.soak import RATE, by_thirds, lasted, main, wander


def looped(pictures: int, rounds: int, motion: Array) -> list[tuple[float, Array]]:
    """A path that each round repeats, moved by ``motion`` once more than the round before."""
    rng = np.random.default_rng(0)
    once = [from_rt(so3_exp(rng.normal(size=3)), rng.normal(size=3)) for _ in range(pictures)]
    moved = [np.linalg.matrix_power(motion, k) for k in range(rounds)]
    return [((k * pictures + i) / RATE, moved[k] @ once[i]) for k in range(rounds) for i in range(pictures)]


@pytest.mark.parametrize("minutes", ["0", "-1", "nan", "0.5"])
def test_a_run_too_short_to_be_told_by_thirds_is_refused(minutes: str, capsys) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["--minutes", minutes])
    assert ended.value.code == 2
    assert "--minutes" in capsys.readouterr().err


def test_a_map_that_stays_does_not_wander_and_one_that_moves_does_so_by_its_motion() -> None:
    assert wander(looped(20, 3, np.eye(4)), 20) == [(0.0, pytest.approx(0.0, abs=1e-5))] * 2
    shifted = wander(looped(20, 4, from_rt(np.eye(3), np.array([0.03, 0.0, 0.04]))), 20)
    assert shifted == [(pytest.approx(5.0 * k), pytest.approx(0.0, abs=1e-5)) for k in (1, 2, 3)]
    turned = wander(looped(20, 3, from_rt(so3_exp(np.radians([0.0, 0.0, 0.7])), np.zeros(3))), 20)
    assert [degrees for _, degrees in turned] == pytest.approx([0.7, 1.4])


def test_rounds_that_are_not_whole_are_left_out_and_none_says_nothing() -> None:
    path = looped(20, 3, from_rt(np.eye(3), np.array([0.01, 0.0, 0.0])))
    assert [cm for cm, _ in wander(path[11:], 20)] == pytest.approx([1.0])  # nine pictures of the first
    assert [cm for cm, _ in wander(path[3:33], 20)] == pytest.approx([1.0])
    assert wander(path[:29], 20) == wander([], 20) == []


def test_a_service_that_died_altogether_did_not_last_though_no_process_was_started_again() -> None:
    restarts = {"tracker": "0", "source": "0"}

    def missed(**changed: object) -> list[str]:
        given = {"gap_s": 0.08, "restarts": restarts, "exits": [], "code": 0} | changed
        return [name for name, (_, met) in lasted(**given).items() if not met]  # type: ignore[arg-type]

    assert missed() == []
    assert missed(gap_s=1.2) == ["never longer than 1 s without a pose"]
    again = ["no process started again"]
    assert missed(restarts={**restarts, "tracker": "1"}) == missed(restarts={}) == again
    assert missed(exits=[-9]) == missed(code=1) == missed(code=None) == ["one run, that ends with 0"]
    assert one_run([-9], 0)[0] == "0, and before that by itself with -9"


def test_costs_of_each_third_are_told_apart_and_a_host_that_takes_is_not_the_daemon() -> None:
    def sample(poses: int, own: float, others: float) -> dict[str, object]:
        cpu = {"tracker": 0.75 * own, "source": 0.25 * own}
        seconds = poses / 10.0
        return {"poses": poses, "cpu_s": cpu, "machine": (own + others, 2.0 * seconds)}

    # 20 ms a pose, twice as much in the last third; others take half of the machine in the second.
    numbers = [(0, 0, 0), (150, 3, 0), (300, 6, 0), (450, 9, 15), (600, 12, 30), (750, 18, 30), (900, 24, 30)]
    thirds = by_thirds([sample(*row) for row in numbers])
    assert [third["cpu_ms_per_pose"]["total"] for third in thirds] == [20.0, 20.0, 40.0]
    assert [third["cpu_ms_per_pose"]["tracker"] for third in thirds] == [15.0, 15.0, 30.0]
    assert [third["foreign_cpu"] for third in thirds] == pytest.approx([0.0, 0.5, 0.0])


def test_a_process_that_came_later_and_a_machine_that_tells_nothing_are_no_reason_to_fail() -> None:
    first = {"poses": 0, "cpu_s": {"tracker": 1.0}, "machine": None}
    last = {"poses": 10, "cpu_s": {"tracker": 1.1, "depth": 0.1}, "machine": None}
    thirds = by_thirds([first, last])
    spent = {"tracker": 10.0, "depth": 10.0, "total": 20.0}
    assert thirds[1] == {"cpu_ms_per_pose": spent, "foreign_cpu": None}
    assert by_thirds([first])[0]["cpu_ms_per_pose"] == {"total": 0.0}
    again = {"poses": 20, "cpu_s": {"tracker": 0.05, "depth": 0.2}, "machine": None}  # started anew
    spent = by_thirds([first, last, last, again])[2]["cpu_ms_per_pose"]
    assert spent == {"tracker": 5.0, "depth": 10.0, "total": 15.0}
